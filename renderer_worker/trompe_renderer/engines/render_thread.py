"""The one thread that may touch the engine, and the agents' turns on it: one picture a turn.

The next turn goes to the waiting agent whose turns have taken the least time, so agents with large pictures do not
delay agents with small ones.
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

from trompe_renderer.engines.engine import Engine
from trompe_renderer.world.snapshot import Snapshot
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererLostError, TrompeError

TURN_LIMIT: Final = 120.0
"""Seconds after which a picture, and the engine with it, counts as hung."""

LAST_WORDS: Final = 0.2
"""Seconds in which the agent can still be told that the engine is lost."""

EMPTY: Final = Snapshot((), np.eye(4), (), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

T = TypeVar("T")

log = logging.getLogger(__name__)


def _exit_process(reason: str) -> None:
    """A lost engine cannot be restored within a process."""
    log.critical("The engine is lost and this process ends; start another one. Reason: %s", reason)
    os._exit(os.EX_TEMPFAIL)


class FairQueue:
    """Agents that wait for a turn. An agent is any object; its account ends with the object."""

    def __init__(self) -> None:
        self._waiting: list[tuple[object, Callable[[], Any]]] = []
        self._used: WeakKeyDictionary[object, float] = WeakKeyDictionary()
        self._least = 0.0
        self._lock = threading.Lock()

    def join(self, agent: object, work: Callable[[], Any]) -> None:
        """Wait for a turn. Time away earns no credit."""
        with self._lock:
            self._used[agent] = max(self._used.get(agent, 0.0), self._least)
            self._waiting.append((agent, work))

    def next(self) -> tuple[object, Callable[[], Any]]:
        """The agent with the least used time, first come first served, and its work."""
        with self._lock:
            turn = min(self._waiting, key=lambda each: self._used[each[0]])
            self._waiting.remove(turn)
            self._least = self._used[turn[0]]
            return turn

    def charge(self, agent: object, seconds: float) -> None:
        """Add the duration of a turn to the agent's account."""
        with self._lock:
            self._used[agent] += seconds


class RenderThread:
    """Runs an engine in a thread of its own. Any thread may ask; ``agent`` is the object that takes a turn.

    ``lost`` is called with the reason when the engine hangs or fails for good. By default it ends the process with the
    exit status ``os.EX_TEMPFAIL``.
    """

    def __init__(
        self,
        engine: Callable[[], Engine],
        *,
        lost: Callable[[str], None] = _exit_process,
        turn_limit: float = TURN_LIMIT,
    ) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="render")
        self._lost, self._limit = lost, turn_limit
        self._since: float | None = None
        self._failure: str | None = None
        self._queue = FairQueue()
        self._engine = self._thread.submit(engine).result()
        threading.Thread(target=self._watch, name="watch", daemon=True).start()

    @property
    def info(self) -> EngineInfo:
        """The engine's identity."""
        return self._engine.info

    def run(self, work: Callable[[Engine], T], *, agent: object) -> "Future[T]":
        """Queue ``work`` with the engine."""
        done: Future[T] = Future()

        def fulfil() -> None:
            try:
                done.set_result(self._watched(work))
            except BaseException as error:
                done.set_exception(error)

        self._queue.join(agent, fulfil)
        self._thread.submit(self._take_turn)
        return done

    def _take_turn(self) -> None:
        agent, fulfil = self._queue.next()
        started = time.monotonic()
        fulfil()
        self._queue.charge(agent, time.monotonic() - started)
        if self._failure is not None:
            time.sleep(LAST_WORDS)
            self._lost(self._failure)

    def _watched(self, work: Callable[[Engine], T]) -> T:
        self._since = time.monotonic()
        try:
            return work(self._engine)
        except TrompeError:
            raise
        except SystemExit as error:
            failure = RuntimeError(f"the engine called sys.exit({error})")
            self._check_engine(failure)
            raise failure from error
        except Exception as error:
            self._check_engine(error)
            raise
        finally:
            self._since = None

    def _check_engine(self, error: Exception) -> None:
        """Raise ``RendererLostError`` if after a failure not even an empty picture can be drawn."""
        try:
            self._engine.render(EMPTY, width=8, height=8)
        except (Exception, SystemExit) as second:
            log.error("a picture failed", exc_info=error)
            self._failure = f"{error!r}, and then {second!r} on an empty picture"
            raise RendererLostError(f"the engine {self.info.name} failed: {self._failure}") from error

    def _watch(self) -> None:
        while True:
            time.sleep(min(1.0, self._limit / 4))
            since = self._since
            if since is not None and time.monotonic() - since > self._limit:
                self._lost(f"a picture takes more than {self._limit:g} s")
                return
