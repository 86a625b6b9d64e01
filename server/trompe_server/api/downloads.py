"""Streamed downloads: a file or a range of it with its hash as ETag, or many files as a zip."""

import hashlib
import re
import zipfile
from collections.abc import Iterable, Iterator
from datetime import datetime
from functools import lru_cache
from mimetypes import guess_type
from typing import BinaryIO, Final, cast

from fastapi import Request
from fastapi.responses import Response, StreamingResponse

from trompe_server.api.problems import RefusedError
from trompe_server.storage.folders import JobArtifacts

PART: Final = 256 * 2**10
REMEMBERED: Final = 10_000
_RANGE: Final = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_PACKED: Final = frozenset({".gif", ".jpg", ".npz", ".png", ".webp", ".zip"})
"""Suffixes of compressed files."""


def digest_of(artifacts: JobArtifacts, name: str) -> str:
    """SHA-256 of a file in hexadecimal."""
    with artifacts.open(name) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


lasting_digest: Final = lru_cache(REMEMBERED)(digest_of)
"""The same for files that no longer change."""


def send_file(request: Request, artifacts: JobArtifacts, name: str, *, digest: str) -> Response:
    """Response with the file ``name``: 200, 206 for one range, 304 if unchanged. Several ranges get the whole file."""
    size, etag = artifacts.size(name), f'"{digest}"'
    headers = {"ETag": etag, "Cache-Control": "private, no-cache", "Accept-Ranges": "bytes"}
    if _has(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    asked = _asked_range(request, size, etag)
    if asked is not None and not 0 <= asked.start < asked.stop:
        detail = f"The file has {size} bytes; the range {request.headers['range']!r} is outside."
        raise RefusedError(416, "no-such-range", detail, Content_Range=f"bytes */{size}")
    part = asked or range(size)
    headers |= {"Content-Length": str(len(part)), "Content-Disposition": f'inline; filename="{name}"'}
    if asked is not None:
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    media_type = guess_type(name)[0] or "application/octet-stream"
    return StreamingResponse(_parts(artifacts, name, part), 200 if asked is None else 206, headers, media_type)


def zip_stream(artifacts: JobArtifacts, names: Iterable[str], *, time: datetime) -> Iterator[bytes]:
    """A zip of the files ``names``, dated ``time``, in parts: memory holds one part at a time."""
    sink = _Sink()
    with zipfile.ZipFile(cast(BinaryIO, sink), "w") as archive:
        for name in names:
            info = zipfile.ZipInfo(name, time.timetuple()[:6])
            info.compress_type = zipfile.ZIP_STORED if name[name.rfind(".") :] in _PACKED else zipfile.ZIP_DEFLATED
            info.file_size = artifacts.size(name)
            with archive.open(info, "w") as member:
                for part in _parts(artifacts, name, range(info.file_size)):
                    member.write(part)
                    yield sink.take()
    yield sink.take()


class _Sink:
    """A write-only file; ``take`` removes and returns its content."""

    def __init__(self) -> None:
        self._written = bytearray()

    def write(self, data: bytes) -> int:
        self._written += data
        return len(data)

    def flush(self) -> None:
        pass

    def take(self) -> bytes:
        taken = bytes(self._written)
        self._written.clear()
        return taken


def _parts(artifacts: JobArtifacts, name: str, wanted: range) -> Iterator[bytes]:
    with artifacts.open(name) as file:
        file.seek(wanted.start)
        left = len(wanted)
        while left and (part := file.read(min(PART, left))):
            left -= len(part)
            yield part


def _has(header: str | None, etag: str) -> bool:
    """Whether ``If-None-Match`` has this ETag, weak ones included."""
    return header is not None and any(each.strip().removeprefix("W/") in {etag, "*"} for each in header.split(","))


def _asked_range(request: Request, size: int, etag: str) -> range | None:
    """The requested bytes, possibly none; ``None`` for the whole file."""
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if match is None or match[0] == "bytes=-" or request.headers.get("if-range", etag) != etag:
        return None
    first, last = match[1], match[2]
    if not first:
        return range(max(0, size - int(last)), size)
    if last and int(last) < int(first):
        return None
    return range(int(first), min(int(last) + 1, size) if last else size)
