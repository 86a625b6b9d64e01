"""The blocking and the asynchronous port over httpx, which no other module imports."""

import asyncio
import os
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager
from importlib.metadata import version
from typing import Any, Final, TypeVar

import httpx

from trompe_client._core import Request
from trompe_client._errors import ServerUnreachable
from trompe_client._port import finish
from trompe_client._retry import Retries
from trompe_client._settings import Connection
from trompe_shared.addresses import is_loopback
from trompe_shared.errors import SpecError

CONNECT_SECONDS: Final = 10.0
"""Timeout of connecting."""

READING_SECONDS: Final = 300.0
"""Additional timeout after an upload, which the server reads before it answers."""

T = TypeVar("T")


class BlockingPort:
    """Blocks; its coroutines never suspend."""

    def __init__(self, connection: Connection, retries: Retries) -> None:
        self.retries = retries
        self._url, self._timeout = connection.url, connection.timeout
        with _usable_environment():
            self._options = _options(connection)
            self._connect()

    def _connect(self) -> None:
        self._process, self._http = os.getpid(), httpx.Client(**self._options)

    @asynccontextmanager
    async def open(self, request: Request[Any], *, silence: float | None = None) -> AsyncIterator["_Answer"]:
        if self._process != os.getpid():  # forked: on the same connections each would read the other's answers
            self._connect()
        with (
            _translated(self._url),
            _arguments(request, silence, self._timeout) as arguments,
            self._http.stream(**arguments) as response,
        ):
            yield _Answer(response)

    async def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    async def off(self, work: Callable[[], T]) -> T:
        return work()

    async def together(self, calls: Sequence[Callable[[], Coroutine[Any, Any, T]]], *, limit: int) -> list[T]:
        with ThreadPoolExecutor(limit, thread_name_prefix="trompe") as pool:
            futures = [pool.submit(lambda call=call: finish(call())) for call in calls]  # type: ignore[misc]
            try:
                return [future.result() for future in futures]
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    def close(self) -> None:
        """Close the connections."""
        self._http.close()


class AsyncPort:
    """Suspends during I/O; needs asyncio."""

    def __init__(self, connection: Connection, retries: Retries) -> None:
        self.retries = retries
        self._url, self._timeout = connection.url, connection.timeout
        with _usable_environment():
            self._http = httpx.AsyncClient(**_options(connection))

    @asynccontextmanager
    async def open(self, request: Request[Any], *, silence: float | None = None) -> AsyncIterator["_AsyncAnswer"]:
        with _translated(self._url), _arguments(request, silence, self._timeout) as arguments:
            async with self._http.stream(**arguments) as response:
                yield _AsyncAnswer(response)

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def off(self, work: Callable[[], T]) -> T:
        return await asyncio.to_thread(work)

    async def together(self, calls: Sequence[Callable[[], Coroutine[Any, Any, T]]], *, limit: int) -> list[T]:
        places = asyncio.Semaphore(limit)

        async def in_its_place(call: Callable[[], Coroutine[Any, Any, T]]) -> T:
            async with places:
                return await call()

        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(in_its_place(call)) for call in calls]
        return [task.result() for task in tasks]

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()


class _Answer:
    def __init__(self, response: httpx.Response) -> None:
        self.response, self.status = response, response.status_code
        self.headers: Mapping[str, str] = response.headers

    async def body(self) -> bytes:
        return self.response.read()

    async def chunks(self) -> AsyncGenerator[bytes, None]:
        for chunk in self.response.iter_bytes():
            yield chunk

    async def lines(self) -> AsyncGenerator[str, None]:
        for line in self.response.iter_lines():
            yield line


class _AsyncAnswer(_Answer):
    async def body(self) -> bytes:
        return await self.response.aread()

    async def chunks(self) -> AsyncGenerator[bytes, None]:
        async for chunk in self.response.aiter_bytes():
            yield chunk

    async def lines(self) -> AsyncGenerator[str, None]:
        async for line in self.response.aiter_lines():
            yield line


def _options(connection: Connection) -> dict[str, Any]:
    token = {"Authorization": f"Bearer {connection.token}"} if connection.token else {}
    return {
        "base_url": connection.url,
        "headers": {"User-Agent": f"trompe/{version('trompe')}", **token},
        "timeout": httpx.Timeout(connection.timeout, connect=min(CONNECT_SECONDS, connection.timeout)),
        "transport": connection.transport,
        "limits": httpx.Limits(max_connections=None),  # each wait for a job holds one
        # A proxy cannot reach a server on this machine.
        "trust_env": not is_loopback(httpx.URL(connection.url).host),
        "verify": httpx.create_ssl_context(),  # with SSL_CERT_FILE, for that machine too
    }


@contextmanager
def _usable_environment() -> Iterator[None]:
    """Translate the errors of httpx about the variables of the environment that it reads."""
    try:
        yield
    except (httpx.InvalidURL, ImportError, OSError, ValueError) as error:
        raise SpecError(
            f"The network settings of the environment cannot be used ({error}). "
            "Correct HTTP_PROXY, HTTPS_PROXY, ALL_PROXY, NO_PROXY or SSL_CERT_FILE."
        ) from error


@contextmanager
def _arguments(request: Request[Any], silence: float | None, timeout: float) -> Iterator[dict[str, Any]]:
    """Arguments for httpx. A file to upload is open within the block, and httpx streams it."""
    upload = request.upload
    arguments: dict[str, Any] = {
        "method": request.method,
        "url": request.path,
        "params": list(request.params),
        "headers": dict(request.headers) | ({"Content-Type": "application/json"} if request.json else {}),
        "content": request.json,
    }
    if silence is None and upload is not None:
        silence = timeout + READING_SECONDS
    if silence is not None:
        arguments["timeout"] = httpx.Timeout(silence, connect=min(CONNECT_SECONDS, silence))
    if upload is None:
        yield arguments
        return
    with upload.opened() as content:
        yield arguments | {"data": dict(upload.form), "files": {"file": (upload.filename, content)}}


@contextmanager
def _translated(url: str) -> Iterator[None]:
    """Translate httpx's network errors."""
    try:
        yield
    except (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout) as error:
        remedy = "Start one with `trompe serve`, or correct the address, for example in TROMPE_SERVER."
        if "CERTIFICATE_VERIFY_FAILED" in str(error):
            remedy = "Give the file of its authority's certificate in SSL_CERT_FILE, or the name in its certificate."
        raise ServerUnreachable(
            f"No Trompe server answers at {url} ({error or type(error).__name__}). {remedy}"
        ) from error
    except httpx.ReadTimeout as error:
        raise ServerUnreachable(
            f"{url} is connected but does not answer. Check that it is a Trompe server, and its log: it may be frozen."
        ) from error
    except (httpx.RequestError, httpx.InvalidURL) as error:
        raise ServerUnreachable(
            f"The connection to {url} broke ({type(error).__name__}: {error}). Check that it is a Trompe server, and "
            "its log."
        ) from error
