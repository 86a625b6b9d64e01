"""Atomic file writes, and a lock that limits a folder to one process."""

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from trompe_server.errors import ServiceError

_FULL: Final = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def write_whole(path: Path, data: bytes | Path) -> None:
    """Write ``data``, or the contents of the file ``data``, to ``path`` atomically.

    Readers see the old file or the new one, never a part, even after a crash. Raises ``ServiceError`` on a full disk.
    """
    with no_space(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                if isinstance(data, bytes):
                    file.write(data)
                else:
                    with data.open("rb") as source:
                        shutil.copyfileobj(source, file, 2**20)
                file.flush()
                os.fsync(file.fileno())
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise


@contextmanager
def no_space(where: object) -> Iterator[None]:
    """Translate the errors of a full disk at ``where`` to ``ServiceError``."""
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise ServiceError(
            f"There is no space left at {where} ({error.strerror}). The incomplete file was discarded. Free some space "
            "or let retention_days (TROMPE_RETENTION_DAYS) delete old jobs, and try again."
        ) from error


@contextmanager
def exclusive(path: Path, refusal: str) -> Iterator[None]:
    """Hold the lock file ``path``. Raises ``ServiceError(refusal)`` if another process holds it.

    The kernel releases the lock when its holder dies.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        held = FileLock(path).acquire(timeout=0)
    except Timeout as error:
        raise ServiceError(refusal) from error
    with held:
        yield
