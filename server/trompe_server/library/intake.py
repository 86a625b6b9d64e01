"""Incoming files: a temporary folder, and hashes as ids."""

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from trompe_server.system.files import no_space

_PART: Final = 2**20


@contextmanager
def intake() -> Iterator[Path]:
    """A temporary folder for an upload until it is checked."""
    with no_space(tempfile.gettempdir()), tempfile.TemporaryDirectory(prefix="trompe-intake-") as folder:
        yield Path(folder)


def identity_of(data: bytes) -> str:
    """SHA-256 in hex: the id of an upload."""
    return hashlib.sha256(data).hexdigest()


def copy(source: BinaryIO, path: Path) -> str:
    """Copy a file to ``path`` and return its id."""
    digest = hashlib.sha256()
    with path.open("wb") as target:
        while part := source.read(_PART):
            digest.update(part)
            target.write(part)
        target.flush()
        os.fsync(target.fileno())
    return digest.hexdigest()
