"""An agent's end of a socket: every read and every reply has an end, in bytes and in time."""

import contextlib
import fcntl
import socket
import struct
import sys
import termios
import threading
import time
from collections.abc import Iterator
from typing import Final

from trompe_shared.errors import ProtocolError

__all__ = ["Link", "Memory"]

REGISTER_TIMEOUT: Final = 10.0
"""Seconds that an agent has for its handshake."""
REQUEST_TIMEOUT: Final = 60.0
"""Seconds that an agent may take to finish a request it has begun, or to take an answer."""
MAX_REQUEST: Final = 512 * 2**20
"""Largest request, bytes."""
FREE: Final = 2**20
"""Bytes of a request that need no permission."""
_KEEPALIVE: Final = (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 6))
"""An agent whose machine is gone is noticed within two minutes."""

_UNSENT: Final = 0x894B if sys.platform == "linux" else termios.TIOCOUTQ
"""Asks how much is not sent yet (SIOCOUTQNSD); elsewhere, how much has not arrived, which can take 40 ms longer."""


class Memory:
    """What all agents together may take up at a time; an agent that wants more waits for the others."""

    def __init__(self, total: int = 2 * MAX_REQUEST) -> None:
        self._total = self._left = total
        self._freed = threading.Condition()
        self._line = threading.Lock()

    def take(self, count: int, *, timeout: float | None) -> None:
        """Reserve ``count`` bytes. Raises ``TimeoutError`` when they do not become free."""
        with self._freed:
            if not self._freed.wait_for(lambda: self._left >= count, timeout):
                raise TimeoutError("other agents' uploads leave no memory for this one")
            self._left -= count

    def give_back(self, count: int) -> None:
        """End a reservation."""
        with self._freed:
            self._left += count
            self._freed.notify_all()

    @contextlib.contextmanager
    def lent(self, count: int) -> Iterator[None]:
        """Reserve ``count`` bytes, or all there are, for the time of a ``with``.

        One after the other: who wants much is not passed over for those who want little.
        """
        share = min(count, self._total)
        with self._line:
            self.take(share, timeout=None)
        try:
            yield
        finally:
            self.give_back(share)


class Link:
    """One connection. Its agent's thread reads and writes; ``hang_up`` may be called by any."""

    def __init__(self, connection: socket.socket, memory: Memory, *, timeout: float = REQUEST_TIMEOUT) -> None:
        self._socket, self._memory, self._timeout = connection, memory, timeout
        self._bytes = self._reserved = 0
        self._deadline = time.monotonic() + min(REGISTER_TIMEOUT, timeout)
        self.idle_since: float | None = None
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def wait(self) -> int:
        """Wait, for as long as the agent likes, until it begins a request; the byte that it begins with.

        Raises ``EOFError`` when it hangs up.
        """
        self._memory.give_back(self._reserved)
        self._bytes = self._reserved = 0
        self.idle_since = time.monotonic()
        first = self._peek(None)
        self.idle_since = None
        self._deadline = time.monotonic() + self._timeout
        return first

    def says_more(self, seconds: float) -> bool:
        """Whether the agent sends more within ``seconds``."""
        try:
            self._peek(seconds)
        except TimeoutError:
            return False
        return True

    def read(self, count: int) -> bytes:
        """The next ``count`` bytes. Raises ``EOFError``, ``TimeoutError``; ``ProtocolError`` for a request too long.

        All the fields of a request together have a largest size and an end in time.
        """
        self._admit(count)
        parts = bytearray()
        while len(parts) < count:
            self._acknowledge()
            self._socket.settimeout(self._left())
            part = self._socket.recv(min(count - len(parts), 2**20))
            if not part:
                raise EOFError("it closed the connection")
            parts += part
        return bytes(parts)

    def send(self, *pieces: bytes | memoryview) -> None:
        """Send all of it. Raises ``TimeoutError`` when the agent does not take it."""
        self._deadline = time.monotonic() + self._timeout
        for piece in pieces:
            self._socket.settimeout(self._left())
            self._socket.sendall(piece)

    def drain(self) -> None:
        """Wait until all that was sent is on its way, so that the next piece starts a segment of its own."""
        until = time.monotonic() + self._timeout
        while struct.unpack("i", fcntl.ioctl(self._socket, _UNSENT, b"\0" * 4))[0]:
            if time.monotonic() > until:
                raise TimeoutError("it does not take its frame")
            time.sleep(0.0005)

    def hang_up(self) -> None:
        """Read no more: an idle agent's thread ends now, a busy one's after its reply."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RD)

    def close(self) -> None:
        """Give everything back."""
        self._memory.give_back(self._reserved)
        self._reserved = 0
        self._socket.close()

    def _admit(self, count: int) -> None:
        """Count ``count`` bytes of the request; a long one must wait for its share of the memory."""
        self._bytes += count
        if self._bytes > MAX_REQUEST:
            raise ProtocolError(f"A request of more than {MAX_REQUEST >> 20} MiB.")
        if self._bytes > FREE:
            more = self._bytes - self._reserved
            self._memory.take(more, timeout=self._left())
            self._reserved += more

    def _left(self) -> float:
        left = self._deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("it takes too long")
        return left

    def _peek(self, timeout: float | None) -> int:
        """The next byte, which stays to be read."""
        self._acknowledge()
        self._socket.settimeout(timeout)
        if not (data := self._socket.recv(1, socket.MSG_PEEK)):
            raise EOFError("it closed the connection")
        return data[0]

    def _acknowledge(self) -> None:
        """Acknowledge at once: without it each small field of a client waits 40 ms."""
        if hasattr(socket, "TCP_QUICKACK"):
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
