"""Downloads: complete or not at all, with checksums, and resumed after a broken connection.

Bytes go to ``.NAME.SUM.part`` beside the file. SUM is the checksum in the server's ETag, so that a later run can resume
the part. A file appears under its name once its checksum is right.
"""

import contextlib
import glob
import hashlib
import os
import re
from collections.abc import AsyncIterator, Iterable, Mapping
from contextlib import aclosing, asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Final

from trompe_client import _core
from trompe_client._core import Request
from trompe_client._errors import BrokenDownload, ClientError, ContractError, NotWritten
from trompe_client._operations import check, send
from trompe_client._port import Answer, Port
from trompe_shared.api import Job

try:
    import fcntl
except ImportError:  # elsewhere than on Unix
    fcntl = None  # type: ignore[assignment]

ETAG: Final = re.compile(r'(?:W/)?"([0-9a-f]{64})"')
SUM: Final = re.compile(r"\.([0-9a-f]{64})\.part$")
PARTIAL, UNCHANGED, UNSATISFIABLE = 206, 304, 416

WAIT: Final = 0.2
"""Seconds between two looks whether another download into the same folder has ended."""


def check_inside(folder: Path, names: Iterable[str]) -> None:
    """Raise ``ContractError`` for the name of a file outside ``folder``."""
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ContractError(f"The server offers a file named {name!r}, outside {folder}; not written.")


async def fetch_all(port: Port, job_id: str, folder: Path) -> tuple[Job, list[Path]]:
    """Download all artifacts of a job into ``folder``. Returns the job and the paths.

    Raises ``ContractError`` for a path outside the folder, ``BrokenDownload``.
    """
    job = await send(port, _core.job(job_id))
    check_inside(folder, job.artifacts)
    return job, [await fetch(port, _core.artifact(job_id, name), folder / name) for name in job.artifacts]


async def fetch(port: Port, request: Request[bytes], path: Path) -> Path:
    """Download one file to ``path``, in place of an older one. Requests missing bytes only, after other downloads into
    the same folder.

    Raises ``BrokenDownload`` if the checksum stays wrong, ``NotWritten`` e.g. for a full disk.
    """
    try:
        async with _alone(port, path.parent):
            return await _fetch(port, request, path)
    except OSError as error:
        raise NotWritten(
            f"{path} cannot be written ({error.strerror or error}). The server keeps it: make room or choose another "
            "folder, and download again."
        ) from error


@asynccontextmanager
async def _alone(port: Port, folder: Path) -> AsyncIterator[None]:
    """Only one download at a time, of all processes, writes into ``folder``, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        while not _locked(handle):
            await port.sleep(WAIT)
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_UN)  # a forked process may hold the file, too
        os.close(handle)


def _locked(handle: int) -> bool:
    """Whether the folder is locked now, or cannot be, as in some network file systems."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


async def _fetch(port: Port, request: Request[bytes], path: Path) -> Path:
    attempt = 0
    while True:
        part = await port.off(partial(_Part.beside, path))
        try:
            await _fetch_once(port, request, part)
            return path
        except ClientError as error:
            pause = port.retries.pause(error, attempt=attempt)
            if pause is None:
                raise
        await port.sleep(pause)
        grown = (await port.off(partial(_Part.beside, path))).size > part.size
        attempt = 0 if grown else attempt + 1


@dataclass(frozen=True)
class _Part:
    """The first ``size`` bytes of the file for ``path`` with the checksum ``sum``."""

    path: Path
    sum: str | None = None
    size: int = 0

    @classmethod
    def beside(cls, path: Path) -> "_Part":
        """The part of an earlier attempt, or an empty one."""
        for file in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
            if match := SUM.search(file.name):
                return cls(path, match[1], file.stat().st_size)
        return cls(path)

    @property
    def file(self) -> Path:
        """Path of the part."""
        return self.path.with_name(f".{self.path.name}.{self.sum}.part" if self.sum else f".{self.path.name}.part")

    def conditions(self) -> Mapping[str, str]:
        """Headers of a request for the missing bytes."""
        if self.size:
            return {"Range": f"bytes={self.size}-", "If-Range": f'"{self.sum}"'}
        return {"If-None-Match": f'"{_checksum(self.path)}"'} if self.path.is_file() else {}

    def discard(self) -> None:
        """Delete the part."""
        self.file.unlink(missing_ok=True)

    def complete(self) -> None:
        """Check the part and rename it. Raises ``BrokenDownload``."""
        found = self.sum and _checksum(self.file)
        if found != self.sum:
            self.discard()
            raise BrokenDownload(
                f"{self.path.name} has the checksum {found}, the server's is {self.sum}. Try again; if it fails again, "
                "look for a proxy that changes the bytes."
            )
        os.replace(self.file, self.path)


async def _fetch_once(port: Port, request: Request[bytes], part: _Part) -> None:
    conditions = await port.off(part.conditions)
    async with port.open(replace(request, headers={**request.headers, **conditions})) as answer:
        if answer.status == UNCHANGED:
            await port.off(part.discard)
            return
        if answer.status == UNSATISFIABLE:  # the part is complete, or too long
            await port.off(part.complete)
            return
        await check(answer, request)
        part = await _append(port, answer, part)
    await port.off(part.complete)


async def _append(port: Port, answer: Answer, part: _Part) -> _Part:
    """Append the body to ``part``, or start again if the server sends the whole file."""
    going_on = answer.status == PARTIAL and part.sum is not None
    if not going_on:
        await port.off(part.discard)
        match = ETAG.fullmatch(answer.headers.get("ETag") or "")
        part = _Part(part.path, match and match[1])
    with part.file.open("ab" if going_on else "wb") as file:
        async with aclosing(answer.chunks()) as chunks:
            async for chunk in chunks:
                await port.off(partial(file.write, chunk))
    return part


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
