"""What operations need of the world around them: one protocol, which a blocking and an asynchronous client provide.

Operations are written once, as coroutines over a ``Port``. The blocking client's port never suspends them: it does its
work on the spot, so that ``finish`` can run a coroutine from its first line to its last with no event loop at hand.
"""

from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine, Generator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, Protocol, TypeVar, cast

from trompe_client._core import Request
from trompe_client._retry import Retries

T = TypeVar("T")


class Answer(Protocol):
    """A server's answer, whose body comes in little by little."""

    @property
    def status(self) -> int:
        """The HTTP status."""

    @property
    def headers(self) -> Mapping[str, str]:
        """The headers; their names may be asked for in any case."""

    async def body(self) -> bytes:
        """All of the body."""

    def chunks(self) -> AsyncGenerator[bytes, None]:
        """The body piece by piece."""

    def lines(self) -> AsyncGenerator[str, None]:
        """The body line by line, without line ends."""


class Port(Protocol):
    """The way out of an operation. ``retries`` is how often it may try again."""

    @property
    def retries(self) -> Retries:
        """How often what failed is tried again, and after which pause."""

    def open(self, request: Request[Any], *, silence: float | None = None) -> AbstractAsyncContextManager[Answer]:
        """Send one request; its answer can be read within the block. ``silence``: longest time without a byte, seconds.

        Raises ``ServerUnreachable``, also for a connection that breaks within the block.
        """

    async def sleep(self, seconds: float) -> None:
        """Let time pass."""

    async def off(self, work: Callable[[], T]) -> T:
        """Do something that blocks, such as reading a file, out of the way of whatever else goes on."""

    async def together(self, calls: Sequence[Callable[[], Coroutine[Any, Any, T]]], *, limit: int) -> list[T]:
        """What all ``calls`` return, in their order; at most ``limit`` of them go on at a time."""


def finish(operation: Awaitable[T]) -> T:
    """What a coroutine returns that runs over a port which never suspends."""
    steps = operation.__await__()
    try:
        next(steps)
    except StopIteration as done:
        return cast(T, done.value)
    raise RuntimeError("an operation of the blocking client has asked for an event loop")


def iterate(values: AsyncGenerator[T, None]) -> Generator[T, None, None]:
    """The values of an asynchronous generator that runs over a port which never suspends."""
    try:
        while True:
            try:
                value = finish(anext(values))
            except StopAsyncIteration:
                return
            yield value
    finally:
        finish(values.aclose())
