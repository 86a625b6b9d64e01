"""Sockets: accept agents, decode what they ask, let the session answer, send the reply.

Each agent has a thread; one more thread owns the OpenGL context and renders for all of them, in turn.
"""

import fcntl
import io
import itertools
import logging
import math
import socket
import struct
import termios
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from select import select
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_renderer.engine import Engine
from trompe_renderer.model import Library
from trompe_renderer.scenery import Scenery
from trompe_renderer.session import Session
from trompe_shared.errors import ProtocolError, RendererError, TrompeError
from trompe_shared.sailenv import MAX_SIDE, REGISTER, Request, decode_request, encode_frame, views_of

__all__ = ["Server"]

MAX_AGENTS: Final = 64
REQUEST_TIMEOUT: Final = 60.0
"""Seconds that an agent may take to finish a request it has begun, or to take an answer."""
DIALECT_WAIT: Final = 0.3
"""Seconds of silence after a short SPAWN_OBJECT that tell the short dialect from the long one."""
LONG_ONLY: Final = {"spawn_view_frustum", "move_object"}

log = logging.getLogger(__name__)


class Renderer:
    """The engine behind the one thread that may touch it."""

    def __init__(self, *, shadows: bool) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="render")
        self._engine = self._thread.submit(Engine, shadows=shadows).result()

    def render(self, scenery: Scenery, *, width: int, height: int) -> NDArray[np.uint8]:
        """As ``Engine.render``, from any thread."""
        return self._thread.submit(self._engine.render, scenery, width=width, height=height).result()


class Server:
    """A renderer worker that listens on ``address`` once it exists. Raises ``RendererError`` if it cannot."""

    def __init__(self, host: str, port: int, *, shadows: bool = True) -> None:
        try:
            self._listener = socket.create_server((host, port), backlog=MAX_AGENTS)
        except OSError as error:
            raise RendererError(
                f"Cannot listen on {host}:{port} ({error}). Choose another --host or --port."
            ) from error
        self._renderer = Renderer(shadows=shadows)
        self._library = Library()
        self._places = threading.BoundedSemaphore(MAX_AGENTS)
        self.address: tuple[str, int] = self._listener.getsockname()[:2]

    def serve_forever(self) -> None:
        """Accept agents until the process ends."""
        for agent in itertools.count():
            connection, peer = self._listener.accept()
            if not self._places.acquire(blocking=False):
                log.warning("agent %d from %s: turned away, %d agents are served already", agent, peer[0], MAX_AGENTS)
                connection.close()
                continue
            threading.Thread(target=self._serve, args=(connection, agent), daemon=True, name=f"agent-{agent}").start()

    def _serve(self, connection: socket.socket, agent: int) -> None:
        try:
            with connection:
                _Agent(connection, agent, self._renderer, Session(self._library)).serve()
        except ProtocolError as error:
            log.warning("agent %d: closed, what it sent is malformed: %s", agent, error)
        except (EOFError, OSError) as error:
            log.info("agent %d: gone (%s)", agent, error)
        except Exception:
            log.exception("agent %d: closed after an error of the worker", agent)
        finally:
            self._places.release()


class _Agent:
    """One connection."""

    def __init__(self, connection: socket.socket, agent: int, renderer: Renderer, session: Session) -> None:
        self._socket, self._id, self._renderer, self._session = connection, agent, renderer, session
        self._long: bool | None = None
        self._width = self._height = 1
        self._gzip = False
        self._last_frame = time.monotonic()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.settimeout(REQUEST_TIMEOUT)

    def serve(self) -> None:
        """Shake hands and answer requests until DELETE or until the agent hangs up."""
        self._register()
        while True:
            select([self._socket], [], [])
            request = decode_request(self._read, is_long=self._is_long)
            if request.command.name == "delete":
                return
            self._long = self._long or request.command.name in LONG_ONLY or None
            self._answer(request)

    def _register(self) -> None:
        fields = REGISTER.decode_fields(self._read)
        self._width, self._height, self._gzip = fields["width"], fields["height"], fields["gzip"]
        if not (0 < self._width <= MAX_SIDE and 0 < self._height <= MAX_SIDE):
            raise ProtocolError(f"Images of {self._width} x {self._height} are asked for; a side is 1 to {MAX_SIDE}.")
        self._socket.sendall(REGISTER.encode_reply(self._id, self._session.scenes))

    def _read(self, count: int) -> bytes:
        parts = bytearray()
        while len(parts) < count:
            if hasattr(socket, "TCP_QUICKACK"):  # without it each small field of a client waits 40 ms for its ACK
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
            part = self._socket.recv(min(count - len(parts), 2**20))
            if not part:
                raise EOFError("the connection was closed")
            parts += part
        return bytes(parts)

    def _is_long(self) -> bool:
        if self._long is None:
            self._long = bool(select([self._socket], [], [], DIALECT_WAIT)[0])
        return self._long

    def _answer(self, request: Request) -> None:
        command = request.command
        if command.name == "frame":
            self._send_frame(request.values["flags"])
            return
        try:
            values = getattr(self._session, command.name)(**request.values)
        except TrompeError as error:
            self._note(command.name, str(error))
            self._socket.sendall(command.encode_refusal(str(error)))
        else:
            self._socket.sendall(command.encode_reply(*values))

    def _note(self, command: str, reason: str) -> None:
        log.warning("agent %d: refused %s: %s", self._id, command, reason)
        self._session.note_refusal(reason)

    def _send_frame(self, flags: int) -> None:
        """A frame whose rendering fails is sent flat: the client would wait for ever for one that does not come."""
        now = time.monotonic()
        delta_time, self._last_frame = now - self._last_frame, now
        views = {name: _flat(name, self._width, self._height) for name in views_of(flags)}
        try:
            if "main" in views:
                views["main"] = self._main_view()
        except Exception as error:
            log.exception("agent %d: rendering failed", self._id)
            self._session.note_refusal(f"Rendering failed: {error!r}")
            delta_time = math.nan
        for number, piece in enumerate(encode_frame([*views.values()], delta_time=delta_time, compress=self._gzip)):
            if number:
                self._drain()
            self._socket.sendall(piece)

    def _main_view(self) -> bytes:
        """The picture as Unity shows it: the mirror image of the right-handed one."""
        image = self._renderer.render(self._session.scenery(), width=self._width, height=self._height)
        return _png(image[:, ::-1])

    def _drain(self) -> None:
        """Wait until all that was sent has arrived, so that the next piece starts a segment of its own."""
        until = time.monotonic() + REQUEST_TIMEOUT
        while struct.unpack("i", fcntl.ioctl(self._socket, termios.TIOCOUTQ, b"\0" * 4))[0]:
            if time.monotonic() > until:
                raise TimeoutError("the agent does not take its frame")
            time.sleep(0.0005)


def _png(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def _flat(view: str, width: int, height: int) -> bytes:
    """A view that shows nothing, in the form that the protocol gives it."""
    raw: dict[str, Any] = {"category": 3, "optical": 8}
    if view in raw:
        return bytes(width * height * raw[view])
    return _png(np.zeros((height, width) if view == "depth" else (height, width, 3), np.uint8))
