"""Several renderer workers as one target: views are shared out, and a dead or hanging worker costs only time."""

import contextlib
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from trompe_server.renderers.protocol import Images, OnFrame
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, RendererLostError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D
from trompe_shared.sailenv_client import SailenvTarget, engine_at

logger = logging.getLogger(__name__)

Address = tuple[str, int]

SHARE: Final = (4, 8)
"""Fewest and most views per share: enough to pay for an upload, few enough for all workers to finish together."""
REST: Final = 5.0
"""Seconds between two attempts to reach a lost worker."""


@dataclass(eq=False)
class _Worker:
    """One renderer worker.

    busy: views it is rendering. pace: its recent seconds per view. asked: time of its loss or of the last attempt to
    reach it.
    """

    address: Address
    idle: list[SailenvTarget] = field(default_factory=list)
    busy: int = 0
    pace: float = 0.0
    lost: bool = False
    asked: float = 0.0


class RendererPool:
    """A ``TargetRenderer`` over the workers at ``addresses`` with one engine; thread-safe.

    The views of a request are shared out, the least busy worker first. Another worker takes over the missing views of a
    lost one; a worker with another engine counts as lost. A refusal is final: every worker would refuse.

    engine: the only one accepted; by default that of the first worker that answers. suspicion: seconds without an image
    before a worker is checked. patience: seconds a checked worker has to answer.
    """

    def __init__(
        self,
        addresses: Sequence[Address],
        *,
        engine: EngineInfo | None = None,
        suspicion: float = 2.0,
        patience: float = 5.0,
        rest: float = REST,
    ) -> None:
        if not addresses:
            raise RendererError("A pool needs at least one renderer address.")
        self._workers = [_Worker(address) for address in dict.fromkeys(addresses)]
        self._engine = engine
        self._lock, self._engine_lock = threading.Lock(), threading.Lock()
        self.suspicion, self.patience, self._rest = suspicion, patience, rest

    def __repr__(self) -> str:
        return f"RendererPool({[worker.address for worker in self._workers]!r})"

    def __len__(self) -> int:
        return len(self._workers)

    @property
    def engine(self) -> EngineInfo:
        with self._engine_lock:
            if self._engine is None:
                self._engine = self._first_engine()
            return self._engine

    def _first_engine(self) -> EngineInfo:
        for number, worker in enumerate(self._workers, 1):
            try:
                with contextlib.closing(SailenvTarget(*worker.address, timeout=self.patience)) as target:
                    return target.engine
            except RendererLostError:
                if number == len(self._workers):
                    raise
        raise AssertionError("there is at least one worker")

    def render(
        self, obj: Object3D, views: Sequence[View], *, size: tuple[int, int], on_frame: OnFrame | None = None
    ) -> Images:
        """Render as ``TargetRenderer.render``. Raises ``RendererLostError`` if every worker is lost."""
        _ = self.engine
        images = np.zeros((len(views), *size, 3), np.uint8)
        with contextlib.closing(_Request(self, obj, views, images).run()) as pictures:
            for _ in pictures:
                if on_frame is not None:
                    on_frame()
        return images

    def close(self) -> None:
        """Close all connections; the next ``render`` connects again."""
        with self._lock:
            targets = [target for worker in self._workers for target in worker.idle]
            for worker in self._workers:
                worker.idle = []
        for target in targets:
            target.close()

    def best(self, tried: Sequence[_Worker], *, desperate: bool) -> _Worker | None:
        """The next worker, not among ``tried``: the least busy, then the fastest.

        Lost workers are skipped unless ``desperate``.
        """
        with self._lock:
            self._retry_lost()
            left = [worker for worker in self._workers if worker not in tried and (desperate or not worker.lost)]
            return min(left, key=lambda worker: (worker.lost, worker.busy, worker.pace), default=None)

    def _retry_lost(self) -> None:
        for worker in self._workers:
            if worker.lost and time.monotonic() - worker.asked > self._rest:
                worker.asked = time.monotonic()
                threading.Thread(
                    target=self._retry, args=(worker,), name=f"retry {worker.address}", daemon=True
                ).start()

    def _retry(self, worker: _Worker) -> None:
        if engine_at(*worker.address, timeout=self.patience) == self._engine:
            worker.lost = False

    def lend(self, worker: _Worker) -> SailenvTarget:
        """A connection to the worker, for exclusive use."""
        with self._lock:
            if worker.idle:
                return worker.idle.pop()
            return SailenvTarget(*worker.address, engine=self._engine)

    def take_back(self, worker: _Worker, target: SailenvTarget, *, lost: bool) -> None:
        """Return a connection. For a lost worker all of its connections are closed."""
        with self._lock:
            worker.lost, worker.asked = lost, time.monotonic()
            if not lost:
                worker.idle.append(target)
                return
            stale, worker.idle = [target, *worker.idle], []
        for each in stale:
            each.close()

    def count(self, worker: _Worker, views: int) -> None:
        """Add ``views`` (may be negative) to the load of the worker."""
        with self._lock:
            worker.busy += views


class _Assignment:
    """One worker's part in one request: a thread that takes share after share until none is left."""

    def __init__(self, request: "_Request", worker: _Worker) -> None:
        self._request, self.worker = request, worker
        self.target = request.pool.lend(worker)
        self.share = range(0)
        self.done = 0
        self.last_event = time.monotonic()
        self.checked = False
        self.thread = threading.Thread(target=self._run, name=f"render at {worker.address}", daemon=True)
        self.thread.start()

    @property
    def rest(self) -> range:
        """The missing views of its share."""
        return self.share[self.done :]

    def _run(self) -> None:
        error: BaseException | None = None
        try:
            while share := self._request.next_share():
                self._render(share)
        except BaseException as raised:
            error = raised
        self._request.events.put((self, error or True))

    def _render(self, share: range) -> None:
        request, pool = self._request, self._request.pool
        self.share, self.done = share, 0
        pool.count(self.worker, len(share))
        started = time.monotonic()
        mine = slice(share.start, share.stop)
        try:
            shown = self.target.pictures(request.obj, request.views[mine], request.images[mine])
            with contextlib.closing(shown) as pictures:
                for _ in pictures:
                    self.done, self.last_event, self.checked = self.done + 1, time.monotonic(), False
                    request.events.put((self, None))
        finally:
            pool.count(self.worker, -len(share))
        self.worker.pace = (time.monotonic() - started) / len(share)

    def check(self) -> None:
        """Contact the worker over another connection; abort this assignment if it does not answer."""
        self.checked = True
        threading.Thread(target=self._check, name=f"check {self.worker.address}", daemon=True).start()

    def _check(self) -> None:
        if engine_at(*self.worker.address, timeout=self._request.pool.patience) is not None:
            self.last_event, self.checked = time.monotonic(), False
        elif self.checked:
            self.target.abort()


class _Request:
    """One call of ``render``: pending shares, active assignments, arrived images.

    Shares never overlap, and the rest of a share goes to another worker only after its thread has ended: each image has
    one writer at a time and never changes once it was announced.
    """

    def __init__(self, pool: RendererPool, obj: Object3D, views: Sequence[View], images: Images) -> None:
        self.pool, self.obj, self.views, self.images = pool, obj, views, images
        least, most = SHARE
        step = min(max(-(-len(views) // (2 * len(pool))), least), most)
        self._todo = deque(range(k, min(k + step, len(views))) for k in range(0, len(views), step))
        self._assignments: list[_Assignment] = []
        self._tried: list[_Worker] = []  # active and lost workers
        self._losses: dict[str, None] = {}  # in words
        self.events: queue.Queue[tuple[_Assignment, BaseException | bool | None]] = queue.Queue()

    def next_share(self) -> range | None:
        """The next pending share."""
        try:
            return self._todo.popleft()
        except IndexError:
            return None

    def run(self) -> Generator[None]:
        """Yield after each image until all have arrived."""
        try:
            self._assign()
            while self._assignments:
                yield from self._wait()
        finally:
            self._abort()

    def _assign(self) -> None:
        """Assign pending shares to workers, as far as there are any."""
        for _ in range(len(self._todo)):
            worker = self.pool.best(self._tried, desperate=not self._assignments)
            if worker is not None:
                self._tried.append(worker)
                self._assignments.append(_Assignment(self, worker))

    def _wait(self) -> Iterator[None]:
        """Wait for one event; check the workers that have been silent for long."""
        try:
            assignment, ending = self.events.get(timeout=self.pool.suspicion / 4)
        except queue.Empty:
            silent = time.monotonic() - self.pool.suspicion
            for assignment in self._assignments:
                if assignment.last_event < silent and not assignment.checked:
                    assignment.check()
            return
        if ending is None:
            yield
        else:
            self._end(assignment, ending)

    def _end(self, assignment: _Assignment, ending: BaseException | bool) -> None:
        assignment.thread.join()
        self._assignments.remove(assignment)
        lost = isinstance(ending, RendererLostError)
        if not lost:
            self._tried.remove(assignment.worker)
        self.pool.take_back(assignment.worker, assignment.target, lost=lost)
        if isinstance(ending, BaseException) and not lost:
            raise ending
        if lost:
            logger.warning("left out: %s", ending)
            self._losses[str(ending)] = None
        if assignment.rest:
            self._todo.append(assignment.rest)
        self._assign()
        if self._todo and not self._assignments and isinstance(ending, BaseException):
            raise RendererLostError(
                f"No renderer with {self.pool.engine} is left. {' '.join(self._losses)}"
            ) from ending

    def _abort(self) -> None:
        self._todo.clear()
        for assignment in self._assignments:
            assignment.target.abort()
        for assignment in self._assignments:
            assignment.thread.join()
            assignment.target.close()
