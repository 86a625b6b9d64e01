"""Files are sent from where they are: piece by piece, and from the beginning again where that is tried again."""

import asyncio
import hashlib
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from trompe_client import AsyncClient, Client
from trompe_client._plan import background_upload
from trompe_shared.api import BackgroundInfo

LARGE = 8 * 2**20
LITTLE_MEMORY = 2 * 2**20
STORED = BackgroundInfo(id="b1", name="room").model_dump_json()


class Counting(httpx.BaseTransport, httpx.AsyncBaseTransport):
    """A server that counts the zero bytes of what it is sent, and refuses the first ``refusals`` requests."""

    def __init__(self, refusals: int = 0) -> None:
        self.refusals = refusals
        self.zeros: list[int] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        assert isinstance(request.stream, httpx.SyncByteStream)
        return self._answer(request, sum(piece.count(0) for piece in request.stream))

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        assert isinstance(request.stream, httpx.AsyncByteStream)
        return self._answer(request, sum([piece.count(0) async for piece in request.stream]))

    def _answer(self, request: httpx.Request, zeros: int) -> httpx.Response:
        self.zeros.append(zeros)
        assert 0 < int(request.headers["Content-Length"]) - zeros < 1000
        refused = len(self.zeros) <= self.refusals
        return httpx.Response(503 if refused else 201, content=STORED, request=request)


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "room.png"
    path.write_bytes(bytes(LARGE))
    return path


def send(picture: Path, transport: Counting) -> str:
    with Client("http://here", transport=transport) as client:
        return client.upload_background(picture)


def send_with_asyncio(picture: Path, transport: Counting) -> str:
    async def run() -> str:
        async with AsyncClient("http://here", transport=transport) as client:
            return await client.upload_background(picture)

    return asyncio.run(run())


@pytest.mark.parametrize("way", [send, send_with_asyncio])
def test_a_large_file_takes_little_memory(way: Callable[[Path, Counting], str], picture: Path) -> None:
    transport = Counting()
    tracemalloc.start()
    try:
        assert way(picture, transport) == "b1"
        assert tracemalloc.get_traced_memory()[1] < LITTLE_MEMORY
    finally:
        tracemalloc.stop()
    assert transport.zeros == [LARGE]


def test_the_name_of_a_large_file_takes_little_memory(picture: Path) -> None:
    expected = hashlib.sha256(bytes(LARGE)).hexdigest()
    tracemalloc.start()
    try:
        assert background_upload(picture).sha256() == expected
        assert tracemalloc.get_traced_memory()[1] < LITTLE_MEMORY
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("way", [send, send_with_asyncio])
def test_what_is_sent_again_is_the_whole_file(
    way: Callable[[Path, Counting], str], picture: Path, slept: list[float]
) -> None:
    transport = Counting(refusals=2)
    assert way(picture, transport) == "b1"
    assert transport.zeros == [LARGE] * 3
    assert len(slept) == 2
