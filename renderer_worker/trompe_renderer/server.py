"""Sockets: accept agents, decode what they ask, let the session answer, send the reply.

Each agent has a thread; one more thread owns the OpenGL context and renders for all of them, in turn.
"""

import contextlib
import io
import itertools
import logging
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from select import select
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trompe_renderer.link import Link, Memory
from trompe_renderer.model import Library
from trompe_renderer.options import Options
from trompe_renderer.render_thread import Renderer
from trompe_renderer.scenery import Scenery
from trompe_renderer.session import Session
from trompe_renderer.views import flat, label_views
from trompe_shared.errors import ProtocolError, RendererError, TrompeError
from trompe_shared.sailenv import (
    COMMANDS,
    MAX_SIDE,
    REGISTER,
    Request,
    decode_request,
    encode_frame,
    encode_status,
    views_of,
)

__all__ = ["MAX_AGENTS", "Server"]

MAX_AGENTS: Final = 64
PATIENCE: Final = 600.0
"""Seconds for which an agent may be idle and keep its place when others have none."""
GRACE: Final = 8.0
"""Seconds that agents have, when the worker stops, to take the replies they wait for."""
PAUSE: Final = 0.5
"""Seconds until the next try when no agent could be accepted."""
DIALECT_WAIT: Final = 0.3
"""Seconds of silence after a short SPAWN_OBJECT that tell the short dialect from the long one."""
LONG_ONLY: Final = {"spawn_view_frustum", "load_scenario", "move_object"}
AHEAD: Final = 2
"""Pictures of one agent that may be in line or drawn and not yet sent."""
MOST_TOLD: Final = 1000
"""Characters of a refusal's reason that are logged and told."""
PIXEL_BYTES: Final = {"main": 16, "labels": 64}
"""What a pixel of the main view takes while it is drawn, encoded and sent, and one of all the others together."""
SMALL: Final = 32 * 2**20
"""Bytes of a frame or batch that needs no permission."""

_NAMES: Final = {command.code: command.name for command in COMMANDS.values()}

Changes = Sequence[tuple[str, Mapping[str, Any]]]
Picture = NDArray[np.uint8]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Shared:
    """What the agents have in common."""

    renderer: Renderer
    options: Options
    library: Library = field(default_factory=Library)
    memory: Memory = field(default_factory=Memory)
    pictures: Memory = field(default_factory=Memory)
    stopping: threading.Event = field(default_factory=threading.Event)


class Server:
    """A renderer worker behind a listening socket, which it owns from now on.

    Raises ``RendererError`` where nothing can be rendered.
    """

    def __init__(self, listener: socket.socket, options: Options | None = None) -> None:
        options = options or Options()
        self._listener = listener
        self._shared = Shared(Renderer(options.quality), options)
        self._agents: dict[int, tuple[Link, threading.Thread]] = {}
        self._left = threading.Condition()
        self._waker, self._wake = socket.socketpair()
        self._waker.setblocking(False)
        self.address: tuple[str, int] = listener.getsockname()[:2]

    def serve_forever(self) -> None:
        """Accept agents until ``stop``, then let each take the reply it waits for."""
        for agent in itertools.count():
            if self._wake in select([self._listener, self._wake], [], [])[0]:
                break
            try:
                self._accept(agent)
            except OSError as error:  # no file descriptor is left, or it is gone already
                log.warning("agent %d: cannot be accepted: %s", agent, error)
                time.sleep(PAUSE)
        self._finish()

    def stop(self) -> None:
        """Make ``serve_forever`` return. A signal's handler may call it, however often: it takes no lock."""
        with contextlib.suppress(OSError):  # it is full, or all is over
            self._waker.send(b"!")

    def _accept(self, agent: int) -> None:
        connection, peer = self._listener.accept()
        if not self._make_room():
            log.warning("agent %d from %s: turned away, %d agents are served already", agent, peer[0], MAX_AGENTS)
            connection.close()
            return
        link = Link(connection, self._shared.memory)
        thread = threading.Thread(target=self._serve, args=(link, agent), daemon=True, name=f"agent-{agent}")
        self._agents[agent] = link, thread
        thread.start()

    def _finish(self) -> None:
        self._shared.stopping.set()
        for each in (self._listener, self._wake, self._waker):
            each.close()
        agents = [*self._agents.values()]
        for link, _ in agents:
            link.hang_up()
        until = time.monotonic() + GRACE
        for _, thread in agents:
            thread.join(max(0.0, until - time.monotonic()))

    def _make_room(self) -> bool:
        """Whether there is a place for one more; if need be the place of the agent that has been idle for longest."""
        with self._left:
            if len(self._agents) < MAX_AGENTS:
                return True
            idle = [(link.idle_since, link) for link, _ in self._agents.values() if link.idle_since is not None]
            since, link = min(idle, key=lambda item: item[0], default=(math.inf, None))
            if link is None or time.monotonic() - since < PATIENCE:
                return False
            link.hang_up()
            return self._left.wait_for(lambda: len(self._agents) < MAX_AGENTS, timeout=1.0)

    def _serve(self, link: Link, agent: int) -> None:
        try:
            _converse(_Agent(link, agent, self._shared), agent)
        finally:
            link.close()
            with self._left:
                del self._agents[agent]
                self._left.notify_all()


def _converse(client: "_Agent", agent: int) -> None:
    """Serve an agent, and log why that ended."""
    try:
        client.serve()
    except ProtocolError as error:
        reason = str(error)[:MOST_TOLD]
        log.warning("agent %d: closed at %s, what it sent is malformed: %s", agent, client.doing, reason)
    except TimeoutError as error:
        log.warning("agent %d: closed at %s: %s", agent, client.doing, error)
    except (EOFError, OSError) as error:
        log.info("agent %d: gone (%s)", agent, error)
    except Exception:
        log.exception("agent %d: closed at %s after an error of the worker", agent, client.doing)


class _Agent:
    """One connection. ``doing`` is the command that is read or answered, or was last."""

    def __init__(self, link: Link, number: int, shared: Shared) -> None:
        self._link, self._id, self._shared = link, number, shared
        self._renderer, self._options = shared.renderer, shared.options
        self._session = Session(shared.library)
        self._seen: Scenery | None = None
        self._long: bool | None = None
        self._width = self._height = 1
        self._gzip = False
        self._last_frame = time.monotonic()
        self.doing = REGISTER.name

    def serve(self) -> None:
        """Shake hands and answer requests until DELETE or until the agent hangs up."""
        self._register()
        while True:
            self.doing = _NAMES.get(code := self._link.wait(), f"{code:#04x}")
            request = decode_request(self._link.read, is_long=self._is_long)
            if request.command.name == "delete":
                return
            if request.command.name in LONG_ONLY:
                self._long = True
            self._answer(request)

    def _register(self) -> None:
        fields = REGISTER.decode_fields(self._link.read)
        self._width, self._height, self._gzip = fields["width"], fields["height"], fields["gzip"]
        if not (0 < self._width <= MAX_SIDE and 0 < self._height <= MAX_SIDE):
            raise ProtocolError(f"Images of {self._width} x {self._height} are asked for; a side is 1 to {MAX_SIDE}.")
        self._session.size = self._width, self._height
        self._link.send(REGISTER.encode_reply(self._id, self._session.scenes))

    def _is_long(self) -> bool:
        if self._long is None:
            self._long = self._link.says_more(DIALECT_WAIT)
        return self._long

    def _answer(self, request: Request) -> None:
        command = request.command
        if command.name == "frame":
            self._send_frame(request.values["flags"])
        elif command.name == "render_views":
            self._send_pictures(request.values["views"])
        else:
            try:
                values = getattr(self._session, command.name)(**request.values)
            except Exception as error:  # the client waits for a whole reply, whatever happens
                self._link.send(_refusal(request, self._note(command.name, self._explained(error))))
            else:
                for reason in self._session.take_refusals():
                    self._note(command.name, reason)
                self._link.send(command.encode_reply(*values))

    def _explained(self, error: Exception) -> str:
        """Why something was not done; what was not foreseen is logged with its trace."""
        if isinstance(error, TrompeError):
            return str(error)
        log.error("agent %d: an error of the worker", self._id, exc_info=error)
        return f"The worker failed: {error!r}"

    def _note(self, command: str, reason: str) -> str:
        """Log a refusal and keep its reason for LAST_ERROR; as much of it as is told."""
        told = reason[:MOST_TOLD].encode("utf-8", "replace").decode()
        log.warning("agent %d: refused %s: %s", self._id, command, told)
        self._session.note_refusal(told)
        return told

    def _send_frame(self, flags: int) -> None:
        """A frame whose rendering fails is sent flat: the client would wait for ever for one that does not come."""
        delta_time, names = self._time_step(), [*views_of(flags)]
        cost = ("main" in names) * PIXEL_BYTES["main"] + any(name != "main" for name in names) * PIXEL_BYTES["labels"]
        with self._room_for(cost):
            try:
                self._session.advance(delta_time)
                views = self._views(names)
            except Exception as error:
                self._note("frame", self._explained(error))
                delta_time = math.nan
                views = [flat(name, self._width, self._height) for name in names]
            for number, piece in enumerate(encode_frame(views, delta_time=delta_time, compress=self._gzip)):
                if number:
                    self._link.drain()
                self._link.send(piece)

    def _room_for(self, pixel_bytes: int) -> AbstractContextManager[None]:
        """Memory for so many bytes a pixel, for the time of a ``with``; who asks for much waits for others to send."""
        wanted = self._width * self._height * pixel_bytes
        return contextlib.nullcontext() if wanted <= SMALL else self._shared.pictures.lent(wanted)

    def _send_pictures(self, views: Sequence[Changes]) -> None:
        """Draw a picture while the one before travels."""
        drawn: deque[Future[Picture]] = deque()
        with self._room_for(AHEAD * PIXEL_BYTES["main"]):
            for changes in views:
                drawn.append(self._start_picture(changes))
                if len(drawn) == AHEAD and not self._send_picture(drawn.popleft()):
                    return
            while drawn and self._send_picture(drawn.popleft()):
                pass

    def _start_picture(self, changes: Changes) -> "Future[Picture]":
        try:
            if self._shared.stopping.is_set():
                raise RendererError("The worker is about to stop.")
            for name, values in changes:
                getattr(self._session, name)(**values)
            self._session.advance(self._time_step())
            self._seen = self._session.scenery()
            return self._renderer.start(self._seen, width=self._width, height=self._height, whose=self)
        except TrompeError as error:
            refused: Future[Picture] = Future()
            refused.set_exception(error)
            return refused

    def _send_picture(self, drawn: "Future[Picture]") -> bool:
        """Send it once it is ready; whether it is one, for after a refusal nothing may follow."""
        try:
            picture = np.ascontiguousarray(drawn.result())
        except Exception as error:
            self._link.send(encode_status(self._note("render_views", self._explained(error))))
            return False
        self._link.send(encode_status(), picture.data.cast("B"))
        return True

    def _time_step(self) -> float:
        """Seconds from the frame before to this one."""
        now = time.monotonic()
        passed, self._last_frame = now - self._last_frame, now
        return passed if self._options.time_step is None else self._options.time_step

    def _views(self, names: list[str]) -> list[bytes]:
        """Payloads of the views, as the session stands; flow is what changed since this was called last."""
        scenery = self._session.scenery()
        size: dict[str, Any] = {"width": self._width, "height": self._height, "whose": self}
        views = {}
        if "main" in names:
            views["main"] = _png(self._renderer.render(scenery, **size)[:, ::-1])  # as Unity shows it: mirrored
        labels = [name for name in names if name != "main"]
        if labels:
            survey = self._renderer.survey(scenery, self._seen or scenery, **size)
            views |= label_views(labels, survey, scenery, depth_range=self._options.depth_range)
        self._seen = scenery
        return [views[name] for name in names]


def _refusal(request: Request, reason: str) -> bytes:
    """The whole reply that refuses a request: for a scenario an empty id for each of its objects."""
    command = request.command
    if command.repeated:
        return command.encode_reply(*[""] * len(request.values["scenario"]["objects"]))
    return command.encode_refusal(reason)


def _png(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()
