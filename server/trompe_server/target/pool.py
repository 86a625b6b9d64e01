"""Several renderer workers that act as one: views are shared out, and a worker that dies or hangs costs only time."""

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.target.sailenv import SailenvTarget, answers
from trompe_shared.errors import RendererError, RendererLostError
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

__all__ = ["RendererPool"]

Address = tuple[str, int]
Images = NDArray[np.uint8]

SHARE: Final = (4, 8)
"""Least and most views that a worker is given at a time: enough to be worth an upload, so few that all end together."""
REST: Final = 5.0
"""Seconds after which a worker that was lost is asked whether it is there again."""


@dataclass(eq=False)
class _Worker:
    """One renderer worker. ``busy`` is how many views it is asked for now, ``pace`` its seconds for one lately.

    ``asked`` is when it was last found lost or asked whether it is back.
    """

    address: Address
    idle: list[SailenvTarget] = field(default_factory=list)
    busy: int = 0
    pace: float = 0.0
    lost: bool = False
    asked: float = 0.0


class RendererPool:
    """A ``TargetRenderer`` over the workers at ``addresses``. Any number of threads may use it at a time.

    The least busy worker is asked first, and the views of a request are shared out. What a lost worker has not shown is
    asked of another. A refusal is final, for it would be the same everywhere. ``timeout`` is how many seconds any one
    answer may take; after ``suspicion`` seconds without a picture a worker is asked whether it is there, and has
    ``patience`` seconds to say so.
    """

    def __init__(
        self, addresses: Sequence[Address], *, timeout: float = 120.0, suspicion: float = 2.0, patience: float = 5.0
    ) -> None:
        if not addresses:
            raise RendererError("A pool needs the address of at least one renderer.")
        self._workers = [_Worker(address) for address in dict.fromkeys(addresses)]
        self._timeout = timeout
        self._lock = threading.Lock()
        self.suspicion, self.patience = suspicion, patience

    def __repr__(self) -> str:
        return f"RendererPool({[worker.address for worker in self._workers]!r})"

    def __len__(self) -> int:
        return len(self._workers)

    def render(
        self,
        obj: Object3D,
        views: Sequence[View],
        *,
        size: tuple[int, int],
        on_frame: Callable[[], None] | None = None,
    ) -> Images:
        """See ``TargetRenderer.render``. Raises ``RendererLostError`` once every worker is lost."""
        images = np.zeros((len(views), *size, 3), np.uint8)
        with contextlib.closing(_Request(self, obj, views, images).fulfil()) as pictures:
            for _ in pictures:
                if on_frame is not None:
                    on_frame()
        return images

    def close(self) -> None:
        """Hang up everywhere; the next ``render`` connects anew."""
        with self._lock:
            targets = [target for worker in self._workers for target in worker.idle]
            for worker in self._workers:
                worker.idle = []
        for target in targets:
            target.close()

    def best(self, tried: Sequence[_Worker], *, desperate: bool) -> _Worker | None:
        """The worker to ask next that is not among ``tried``: the least busy, of those the quickest.

        Lost workers are left alone, but when ``desperate``.
        """
        with self._lock:
            self._look_for_the_lost()
            left = [worker for worker in self._workers if worker not in tried and (desperate or not worker.lost)]
            return min(left, key=lambda worker: (worker.lost, worker.busy, worker.pace), default=None)

    def _look_for_the_lost(self) -> None:
        for worker in self._workers:
            if worker.lost and time.monotonic() - worker.asked > REST:
                worker.asked = time.monotonic()
                threading.Thread(target=self._find, args=(worker,), name=f"find {worker.address}", daemon=True).start()

    def _find(self, worker: _Worker) -> None:
        if answers(*worker.address, timeout=self.patience):
            worker.lost = False

    def lend(self, worker: _Worker) -> SailenvTarget:
        """A connection to the worker that nobody else uses."""
        with self._lock:
            return worker.idle.pop() if worker.idle else SailenvTarget(*worker.address, timeout=self._timeout)

    def take_back(self, worker: _Worker, target: SailenvTarget, *, lost: bool) -> None:
        """End a loan. With a lost worker all connections to it are given up."""
        with self._lock:
            worker.lost, worker.asked = lost, time.monotonic()
            if not lost:
                worker.idle.append(target)
                return
            stale, worker.idle = [target, *worker.idle], []
        for each in stale:
            each.close()

    def count(self, worker: _Worker, views: int) -> None:
        """Note that the worker has so many views more to render, or fewer."""
        with self._lock:
            worker.busy += views


class _Errand:
    """One worker's part in one request, in a thread of its own: it takes share after share until none is left."""

    def __init__(self, request: "_Request", worker: _Worker) -> None:
        self._request, self.worker = request, worker
        self.target = request.pool.lend(worker)
        self.share = range(0)
        self.done = 0
        self.heard = time.monotonic()
        self.checked = False
        self.thread = threading.Thread(target=self._run, name=f"render at {worker.address}", daemon=True)
        self.thread.start()

    @property
    def rest(self) -> range:
        """What of its share it has not shown."""
        return self.share[self.done :]

    def _run(self) -> None:
        error: BaseException | None = None
        try:
            while share := self._request.next_share():
                self._render(share)
        except BaseException as raised:
            error = raised
        self._request.news.put((self, error or True))

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
                    self.done, self.heard, self.checked = self.done + 1, time.monotonic(), False
                    request.news.put((self, None))
        finally:
            pool.count(self.worker, -len(share))
        self.worker.pace = (time.monotonic() - started) / len(share)

    def check(self) -> None:
        """Ask the worker, on another connection, whether it is there; if it is not, end this errand."""
        self.checked = True
        threading.Thread(target=self._check, name=f"ask {self.worker.address}", daemon=True).start()

    def _check(self) -> None:
        if answers(*self.worker.address, timeout=self._request.pool.patience):
            self.heard, self.checked = time.monotonic(), False
        elif self.checked:
            self.target.abort()


class _Request:
    """One call of ``render``: what is to do, who does it, what has come.

    Shares never overlap, and what is left of one goes to another worker only when the thread that had it has ended: so
    each image is written by one worker at a time, and stays once it has been shown.
    """

    def __init__(self, pool: RendererPool, obj: Object3D, views: Sequence[View], images: Images) -> None:
        self.pool, self.obj, self.views, self.images = pool, obj, views, images
        least, most = SHARE
        step = min(max(-(-len(views) // (2 * len(pool))), least), most)
        self._todo = deque(range(k, min(k + step, len(views))) for k in range(0, len(views), step))
        self._errands: list[_Errand] = []
        self._tried: list[_Worker] = []  # those that are at it, and those that are lost
        self.news: queue.Queue[tuple[_Errand, BaseException | bool | None]] = queue.Queue()

    def next_share(self) -> range | None:
        """Views that nobody renders yet."""
        try:
            return self._todo.popleft()
        except IndexError:
            return None

    def fulfil(self) -> Generator[None]:
        """Stop after each picture, until all are there."""
        try:
            self._send_out()
            while self._errands:
                yield from self._hear()
        finally:
            self._call_off()

    def _send_out(self) -> None:
        """An errand for each share, as long as there are workers."""
        for _ in range(len(self._todo)):
            worker = self.pool.best(self._tried, desperate=not self._errands)
            if worker is not None:
                self._tried.append(worker)
                self._errands.append(_Errand(self, worker))

    def _hear(self) -> Iterator[None]:
        """Wait for one piece of news, or look after those who have been silent for long."""
        try:
            errand, ending = self.news.get(timeout=self.pool.suspicion / 4)
        except queue.Empty:
            silent = time.monotonic() - self.pool.suspicion
            for errand in self._errands:
                if errand.heard < silent and not errand.checked:
                    errand.check()
            return
        if ending is None:
            yield
        else:
            self._end(errand, ending)

    def _end(self, errand: _Errand, ending: BaseException | bool) -> None:
        errand.thread.join()
        self._errands.remove(errand)
        lost = isinstance(ending, RendererLostError)
        if not lost:
            self._tried.remove(errand.worker)
        self.pool.take_back(errand.worker, errand.target, lost=lost)
        if isinstance(ending, BaseException) and not lost:
            raise ending
        if errand.rest:
            self._todo.append(errand.rest)
        self._send_out()
        if self._todo and not self._errands and isinstance(ending, BaseException):
            raise ending

    def _call_off(self) -> None:
        """End what still goes on."""
        self._todo.clear()
        for errand in self._errands:
            errand.target.abort()
        for errand in self._errands:
            errand.thread.join()
            errand.target.close()
