"""Whole-or-nothing writing of files, and the lock that keeps a folder to one process."""

import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from trompe_server.errors import ServiceError

__all__ = ["exclusive", "no_space", "write_whole"]

_FULL: Final = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def write_whole(path: Path, data: bytes | Path) -> None:
    """Write ``data``, or the bytes of that file, to ``path``, whole or not at all.

    Readers, and a crash, see the old file or the new one, never a part. Raises ``ServiceError`` without space.
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
    """Say in words that there is no space left at ``where``."""
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise ServiceError(
            f"There is no space left at {where} ({error.strerror}). Nothing was kept of what did not fit; free some "
            "space, or let retention_days (TROMPE_RETENTION_DAYS) delete old jobs, and try again."
        ) from error


@contextmanager
def exclusive(path: Path, refusal: str) -> Iterator[None]:
    """Hold the lock file ``path``; raises ``ServiceError(refusal)`` where another process holds it.

    The kernel lets go of the lock when its holder dies, however it dies.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ServiceError(refusal) from error
        yield
