"""The worker's end of an agent's socket: every read and every reply is limited in bytes and time."""

import contextlib
import fcntl
import socket
import struct
import time
from typing import Final

from trompe_renderer.protocol.limits import MIB, Limits, MemoryBudget
from trompe_shared.errors import ProtocolError

_KEEPALIVE: Final = ((socket.TCP_KEEPIDLE, 60), (socket.TCP_KEEPINTVL, 10), (socket.TCP_KEEPCNT, 6))
"""Detects a vanished machine within two minutes."""

_UNSENT: Final = 0x894B
"""Number of unsent bytes (SIOCOUTQNSD)."""


class Link:
    """One connection. The agent's thread reads and writes; any thread may call ``hang_up``.

    ``idle_since`` is the time of the last answer (monotonic), ``None`` within a request.
    """

    def __init__(self, connection: socket.socket, memory: MemoryBudget, limits: Limits) -> None:
        self._socket, self._memory, self._limits = connection, memory, limits
        self._bytes = self._reserved = 0
        self._set_deadline(self._limits.register_timeout)
        self.idle_since: float | None = None
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE:
            connection.setsockopt(socket.IPPROTO_TCP, option, value)

    def wait(self) -> int:
        """Wait without limit until the agent begins a request. Returns its first byte and leaves it unread.

        Raises ``EOFError`` when the agent hangs up.
        """
        self._memory.give_back(self._reserved)
        self._bytes = self._reserved = 0
        self.idle_since = time.monotonic()
        first = self._peek(None)
        self.idle_since = None
        self._set_deadline(self._limits.request_timeout)
        return first

    def says_more(self, seconds: float) -> bool:
        """Whether more bytes arrive within ``seconds``."""
        try:
            self._peek(seconds)
        except TimeoutError:
            return False
        return True

    def read(self, count: int) -> bytes:
        """The next ``count`` bytes.

        Raises ``EOFError``, ``TimeoutError``, and ``ProtocolError`` for a request beyond the size limit. The limits of
        size and time apply to all fields of a request together.
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
        """Send all pieces. Raises ``TimeoutError`` when the agent does not take them."""
        self._set_deadline(self._limits.request_timeout)
        for piece in pieces:
            self._socket.settimeout(self._left())
            self._socket.sendall(piece)

    def drain(self) -> None:
        """Wait until all bytes are sent, so that the next piece starts a new segment. Raises ``TimeoutError``."""
        self._set_deadline(self._limits.request_timeout)
        while struct.unpack("i", fcntl.ioctl(self._socket, _UNSENT, b"\0" * 4))[0]:
            self._left()
            time.sleep(0.0005)

    def hang_up(self) -> None:
        """Stop reading: an idle agent's thread ends now, a busy one's after its reply."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RD)

    def close(self) -> None:
        """Close the socket and end the memory reservation."""
        self._memory.give_back(self._reserved)
        self._reserved = 0
        self._socket.close()

    def _admit(self, count: int) -> None:
        """Count bytes of the request; a long one waits for memory."""
        self._bytes += count
        if self._bytes > self._limits.request_size:
            raise ProtocolError(f"A request has more than {self._limits.request_size // MIB} MiB; split it.")
        if self._bytes > self._limits.free_request_size:
            more = self._bytes - self._reserved
            self._memory.take(more, timeout=self._left())
            self._reserved += more

    def _set_deadline(self, seconds: float) -> None:
        self._deadline = time.monotonic() + seconds

    def _left(self) -> float:
        left = self._deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("timed out")
        return left

    def _peek(self, timeout: float | None) -> int:
        """The next byte, left unread."""
        self._acknowledge()
        self._socket.settimeout(timeout)
        if not (data := self._socket.recv(1, socket.MSG_PEEK)):
            raise EOFError("it closed the connection")
        return data[0]

    def _acknowledge(self) -> None:
        """Acknowledge at once: otherwise each small field of a client waits 40 ms."""
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
