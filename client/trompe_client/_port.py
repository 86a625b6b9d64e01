"""Protocol between operations and I/O, implemented for the blocking and the asynchronous client.

Operations are written once, as coroutines over a ``Port``. The blocking port never suspends them, so ``finish`` can run
a coroutine to its end without an event loop.
"""

import functools
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Generator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, cast

from trompe_client._core import Request
from trompe_client._retry import Retries

A = ParamSpec("A")
T = TypeVar("T")


class Answer(Protocol):
    """A server's answer with a streamed body."""

    status: int
    """The HTTP status."""
    headers: Mapping[str, str]
    """The headers, with case-insensitive names."""

    async def body(self) -> bytes:
        """All of the body."""

    def chunks(self) -> AsyncGenerator[bytes, None]:
        """The body piece by piece."""

    def lines(self) -> AsyncGenerator[str, None]:
        """The body line by line, without line ends."""


class Port(Protocol):
    """I/O of an operation."""

    retries: Retries
    """Limit and pauses of retries."""

    def open(self, request: Request[Any], *, silence: float | None = None) -> AbstractAsyncContextManager[Answer]:
        """Send one request; the answer is readable within the block. ``silence``: longest time without a byte, seconds.

        Raises ``ServerUnreachable``, also if the connection breaks within the block.
        """

    async def sleep(self, seconds: float) -> None:
        """Wait."""

    async def off(self, work: Callable[[], T]) -> T:
        """Run blocking work, such as reading a file, without blocking an event loop."""

    async def together(self, calls: Sequence[Callable[[], Coroutine[Any, Any, T]]], *, limit: int) -> list[T]:
        """Results of all ``calls``, in their order; at most ``limit`` run at a time."""


def finish(operation: Awaitable[T]) -> T:
    """Result of a coroutine over a blocking port."""
    steps = operation.__await__()
    try:
        next(steps)
    except StopIteration as done:
        return cast(T, done.value)
    raise RuntimeError("an operation of the blocking client needs an event loop")


def blocking(method: Callable[Concatenate[Any, A], Coroutine[Any, Any, T]]) -> Callable[Concatenate[Any, A], T]:
    """A coroutine method as a blocking one, for objects with a blocking port."""

    @functools.wraps(method)
    def run(self: Any, /, *args: A.args, **options: A.kwargs) -> T:
        return finish(method(self, *args, **options))

    return run


def iterate(values: AsyncGenerator[T, None]) -> Generator[T, None, None]:
    """Values of an asynchronous generator over a blocking port."""
    try:
        while True:
            try:
                value = finish(anext(values))
            except StopAsyncIteration:
                return
            yield value
    finally:
        finish(values.aclose())
