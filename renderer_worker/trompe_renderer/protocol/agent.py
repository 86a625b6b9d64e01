"""One agent's conversation: decodes its requests, lets the session answer, sends replies and pictures."""

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engines.engine import Engine, GBuffer, LabellingEngine, draw
from trompe_renderer.engines.render_thread import RenderThread
from trompe_renderer.protocol.label_views import flat_view, label_views, main_view
from trompe_renderer.protocol.limits import Limits, MemoryBudget, Options
from trompe_renderer.protocol.link import Link
from trompe_renderer.protocol.session import Session
from trompe_renderer.protocol.upload import ModelCache
from trompe_renderer.world.scenes import SCENES
from trompe_renderer.world.snapshot import Snapshot
from trompe_shared.errors import ProtocolError, RendererError, RendererLostError, TrompeError
from trompe_shared.sailenv import (
    COMMANDS,
    LOST,
    MAX_SIDE,
    REGISTER,
    Command,
    decode_request,
    encode_frame,
    encode_status,
    views_of,
)

DIALECT_WAIT: Final = 0.3
"""Seconds of silence after a short SPAWN_OBJECT that tell the short dialect from the long one."""
LONG_ONLY: Final = {"spawn_view_frustum", "load_scenario", "move_object"}
AHEAD: Final = 2
"""Pictures of one agent that may be queued or drawn and not yet sent."""
MAX_REASON: Final = 1000
"""Characters of a refusal's reason in the log and in replies."""
PIXEL_BYTES: Final = {"main": 16, "labels": 64}
"""Memory of a pixel in drawing, encoding and sending: of the main view, and of all other views together."""

_NAMES: Final = {command.code: command.name for command in COMMANDS.values()}

Changes = Sequence[tuple[str, Mapping[str, Any]]]
Picture = NDArray[np.uint8]

log = logging.getLogger(__name__)


class Shared:
    """State shared by all agents of a server."""

    def __init__(self, renderer: RenderThread, options: Options, limits: Limits) -> None:
        self.renderer, self.options, self.limits = renderer, options, limits
        self.models = ModelCache(limits)
        self.requests = MemoryBudget(limits.requests_total)
        self.frames = MemoryBudget(limits.frames_total)
        self.stopping = threading.Event()


class Agent:
    """One connection. ``doing`` is the present or last command."""

    def __init__(self, link: Link, number: int, shared: Shared) -> None:
        self._link, self._number, self._shared = link, number, shared
        self._renderer, self._options = shared.renderer, shared.options
        self._session = Session(shared.models, shared.renderer.info)
        self._seen: Snapshot | None = None
        self._long: bool | None = None
        self._size = {"width": 1, "height": 1}
        self._gzip = False
        self._last_frame = time.monotonic()
        self.doing = REGISTER.name

    def serve(self) -> None:
        """Shake hands and answer requests until DELETE or the end of the connection."""
        self._register()
        while True:
            self.doing = _NAMES.get(code := self._link.wait(), f"{code:#04x}")
            command, values = decode_request(self._link.read, is_long=self._is_long)
            if command.name == "delete":
                return
            if command.name in LONG_ONLY:
                self._long = True
            self._answer(command, values)

    def _register(self) -> None:
        fields = REGISTER.decode_fields(self._link.read)
        self._gzip, width, height = fields["gzip"], fields["width"], fields["height"]
        if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
            raise ProtocolError(f"Images of {width} x {height} pixels; a side must be 1 to {MAX_SIDE}.")
        self._size, self._session.size = {"width": width, "height": height}, (width, height)
        self._link.send(REGISTER.encode_reply(self._number, SCENES))

    def _is_long(self) -> bool:
        if self._long is None:
            self._long = self._link.says_more(DIALECT_WAIT)
        return self._long

    def _answer(self, command: Command, values: Mapping[str, Any]) -> None:
        if command.name == "frame":
            self._send_frame(values["flags"])
        elif command.name == "render_views":
            self._send_pictures(values["views"])
        else:
            try:
                answer = getattr(self._session, command.name)(**values) or ()
            except Exception as error:  # the client waits for a whole reply in any case
                self._link.send(_refusal(command, values, self._note(command.name, error)))
            else:
                for refusal in self._session.take_refusals():
                    self._note(command.name, refusal)
                self._link.send(command.encode_reply(*answer))

    def _note(self, command: str, error: Exception) -> str:
        """Log a refusal, an internal error with its traceback. Returns the shortened reason, kept for LAST_ERROR."""
        reason = str(error)
        if not isinstance(error, TrompeError):
            log.error("agent %d: internal error", self._number, exc_info=error)
            reason = f"Internal error of the renderer: {error!r}"
        told = reason[:MAX_REASON].encode("utf-8", "replace").decode()
        log.warning("agent %d: refused %s: %s", self._number, command, told)
        self._session.note_refusal(told)
        return told

    def _send_frame(self, flags: int) -> None:
        """Send a frame. If rendering fails its views are empty: the client waits for them in any case."""
        delta_time, names = self._time_step(), [*views_of(flags)]
        cost = ("main" in names) * PIXEL_BYTES["main"] + any(name != "main" for name in names) * PIXEL_BYTES["labels"]
        with self._frame_memory(cost):
            try:
                self._session.advance(delta_time)
                views = self._views(names)
            except Exception as error:
                self._note("frame", error)
                delta_time = math.nan
                views = [flat_view(name, **self._size) for name in names]
            for number, piece in enumerate(encode_frame(views, delta_time=delta_time, compress=self._gzip)):
                if number:
                    self._link.drain()
                self._link.send(piece)

    def _frame_memory(self, pixel_bytes: int) -> AbstractContextManager[None]:
        """Reserve memory for large frames within a ``with`` block."""
        wanted = math.prod(self._size.values()) * pixel_bytes
        if wanted <= self._shared.limits.free_frame_size:
            return contextlib.nullcontext()
        return self._shared.frames.reserved(wanted)

    def _send_pictures(self, views: Sequence[Changes]) -> None:
        """Send one picture while the next one is drawn."""
        drawn: deque[Future[Picture]] = deque()
        with self._frame_memory(AHEAD * PIXEL_BYTES["main"]):
            for changes in views:
                drawn.append(self._start_picture(changes))
                if len(drawn) == AHEAD and not self._send_picture(drawn.popleft()):
                    return
            while drawn and self._send_picture(drawn.popleft()):
                pass

    def _start_picture(self, changes: Changes) -> "Future[Picture]":
        try:
            if self._shared.stopping.is_set():
                raise RendererError("The renderer is about to stop.")
            for name, values in changes:
                getattr(self._session, name)(**values)
            self._session.advance(self._time_step())
            self._seen = self._session.snapshot()
            return self._picture(self._seen)
        except TrompeError as error:
            refused: Future[Picture] = Future()
            refused.set_exception(error)
            return refused

    def _send_picture(self, drawn: "Future[Picture]") -> bool:
        """Send the picture, or its refusal, after which nothing may follow; whether it was a picture."""
        try:
            picture = drawn.result()
        except Exception as error:
            told = self._note("render_views", error)
            self._link.send(encode_status(LOST + told if isinstance(error, RendererLostError) else told))
            return False
        self._link.send(encode_status(), picture.data.cast("B"))
        return True

    def _time_step(self) -> float:
        """Seconds since the frame before."""
        now = time.monotonic()
        passed, self._last_frame = now - self._last_frame, now
        return passed if self._options.time_step is None else self._options.time_step

    def _views(self, names: list[str]) -> list[bytes]:
        """Payloads of the views; flow is the motion since the last frame."""
        world = self._session.snapshot()
        views = {}
        if "main" in names:
            views["main"] = main_view(self._picture(world).result())
        labels = [name for name in names if name != "main"]
        if labels:
            before = self._seen or world
            gbuffer = self._renderer.run(lambda engine: _labels(engine, world, before, **self._size), agent=self)
            views |= label_views(labels, gbuffer.result(), world, depth_range=self._options.depth_range)
        self._seen = world
        return [views[name] for name in names]

    def _picture(self, world: Snapshot) -> "Future[Picture]":
        return self._renderer.run(lambda engine: draw(engine, world, **self._size), agent=self)


def _labels(engine: Engine, world: Snapshot, before: Snapshot, *, width: int, height: int) -> GBuffer:
    if not isinstance(engine, LabellingEngine):
        raise RendererError(f'The engine {engine.info.name} renders the view "main" only.')
    return engine.gbuffer(world, before, width=width, height=height)


def _refusal(command: Command, values: Mapping[str, Any], reason: str) -> bytes:
    """The whole reply that refuses a request: for a scenario an empty id for each of its objects."""
    if command.repeated:
        return command.encode_reply(*[""] * len(values["scenario"]["objects"]))
    return command.encode_refusal(reason)
