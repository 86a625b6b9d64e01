"""The one thread that may touch OpenGL, and the agents' turns on it: one picture a turn.

Of those who wait, the one has the next turn whose turns took the least time so far: who asks for large pictures does
not make those wait who ask for small ones.
"""

import logging
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from trompe_renderer.engine import Engine
from trompe_renderer.options import Quality
from trompe_renderer.scenery import Scenery
from trompe_renderer.supervise import LOST
from trompe_renderer.survey import Survey
from trompe_shared.errors import TrompeError

__all__ = ["Renderer"]

TURN_LIMIT: Final = 120.0
"""Seconds after which a picture counts as hung, and OpenGL with it."""

Made = TypeVar("Made")

log = logging.getLogger(__name__)


def _leave(reason: str) -> None:
    """End the process at once, for OpenGL cannot be mended within it; whoever supervises starts another."""
    log.critical("OpenGL is lost, this process ends: %s", reason)
    os._exit(LOST)


class _Line:
    """Those who wait for a turn. ``whose`` is any object; what is known of it goes with it."""

    def __init__(self) -> None:
        self._waiting: list[tuple[object, Callable[[], Any]]] = []
        self._used: WeakKeyDictionary[object, float] = WeakKeyDictionary()
        self._least = 0.0
        self._lock = threading.Lock()

    def join(self, whose: object, work: Callable[[], Any]) -> None:
        """Wait for a turn. Who has been away has saved nothing up."""
        with self._lock:
            self._used[whose] = max(self._used.get(whose, 0.0), self._least)
            self._waiting.append((whose, work))

    def next(self) -> tuple[object, Callable[[], Any]]:
        """Whose turn it is, and for what: who used the least, and of those who came first."""
        with self._lock:
            turn = min(self._waiting, key=lambda each: self._used[each[0]])
            self._waiting.remove(turn)
            self._least = self._used[turn[0]]
            return turn

    def charge(self, whose: object, seconds: float) -> None:
        """Note how long a turn took."""
        with self._lock:
            self._used[whose] += seconds


class Renderer:
    """The engine behind its thread. Any thread may ask; ``lost`` is called when OpenGL hangs or fails for good.

    ``whose`` says for whom something is drawn.
    """

    def __init__(
        self,
        quality: Quality,
        *,
        engine: Callable[[Quality], Engine] = Engine,
        lost: Callable[[str], None] = _leave,
        turn_limit: float = TURN_LIMIT,
    ) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="render")
        self._lost, self._limit = lost, turn_limit
        self._since: float | None = None
        self._line = _Line()
        self._engine = self._thread.submit(engine, quality).result()
        threading.Thread(target=self._watch, name="watch", daemon=True).start()

    def start(self, scenery: Scenery, *, width: int, height: int, whose: object) -> "Future[NDArray[np.uint8]]":
        """Line up for a picture (height, width, 3), as ``Engine.render`` makes it."""
        return self._turn(lambda: self._engine.render(scenery, width=width, height=height), whose)

    def render(self, scenery: Scenery, *, width: int, height: int, whose: object) -> NDArray[np.uint8]:
        """As ``Engine.render``."""
        return self.start(scenery, width=width, height=height, whose=whose).result()

    def survey(self, scenery: Scenery, before: Scenery, *, width: int, height: int, whose: object) -> Survey:
        """As ``Engine.survey``."""
        return self._turn(lambda: self._engine.survey(scenery, before, width=width, height=height), whose).result()

    def _turn(self, work: Callable[[], Made], whose: object) -> "Future[Made]":
        made: Future[Made] = Future()

        def fulfil() -> None:
            try:
                made.set_result(self._watched(work))
            except BaseException as error:
                made.set_exception(error)

        self._line.join(whose, fulfil)
        self._thread.submit(self._take_turn)
        return made

    def _take_turn(self) -> None:
        whose, fulfil = self._line.next()
        started = time.monotonic()
        fulfil()
        self._line.charge(whose, time.monotonic() - started)

    def _watched(self, work: Callable[[], Made]) -> Made:
        self._since = time.monotonic()
        try:
            return work()
        except TrompeError:
            raise
        except Exception as error:
            self._try_again(error)
            raise
        finally:
            self._since = None

    def _try_again(self, error: Exception) -> None:
        """After a failure, find out whether it was the scene's or OpenGL's: can anything be drawn at all?"""
        try:
            self._engine.check()
        except Exception as second:
            self._lost(f"{error!r}, and then on an empty picture {second!r}")

    def _watch(self) -> None:
        while True:
            time.sleep(min(1.0, self._limit / 4))
            since = self._since
            if since is not None and time.monotonic() - since > self._limit:
                self._lost(f"a picture is not ready after {self._limit:g} s")
                return
