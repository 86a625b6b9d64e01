"""Hands the jobs of the record to an executor: by priority, what fits, one dispatcher at a time."""

import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from trompe_server.errors import NotFoundError, ServiceError
from trompe_server.executor.port import Ended, Executor
from trompe_server.queue.claims import Claim, Claims, LostJobError
from trompe_server.queue.leases import DISPATCHER, end_lease, take_lease
from trompe_server.queue.workers import forget_workers, record_workers
from trompe_server.storage.database import DatabaseDownError
from trompe_server.system.files import exclusive, write_whole

logger = logging.getLogger(__name__)

WAIT: Final = 0.1
"""Longest wait for the end of an attempt, seconds; then for new jobs."""
INTERVAL: Final = 5.0
"""Longest time between two rounds, seconds."""
RETRY: Final = 1.0
"""Seconds until the next step after an error."""
LEAVE_PATIENCE: Final = 5.0
"""Seconds a stopping dispatcher has to give its jobs back."""


class Dispatcher:
    """Dispatches the jobs of ``claims`` while it holds the lease, as ``name``, which another gets after ``silence``.

    ``open_executor`` is called once it has the lease, and again after the executor was lost. An attempt is lost without
    a heartbeat for ``silence`` or an event for ``stall_timeout``. ``clock`` is monotonic. Durations are in seconds.
    """

    def __init__(
        self,
        claims: Claims,
        open_executor: Callable[[], Executor],
        *,
        name: str,
        silence: float,
        stall_timeout: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._claims, self._open, self._name, self._clock = claims, open_executor, name, clock
        self._silence, self._stall_timeout = silence, stall_timeout
        self._interval = min(INTERVAL, silence / 4)
        self._executor: Executor | None = None
        self._held: dict[str, Claim] = {}
        self._lost: list[tuple[Claim, str]] = []
        self._round = 0.0
        self._heard_since = clock()
        self._ahead = 0.0
        self.fault: str | None = None
        self._tried = threading.Event()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Dispatch in a thread during the block, which begins after the first round or its failure."""
        stop = threading.Event()
        thread = threading.Thread(target=self._run, args=(stop,), name="dispatcher", daemon=True)
        thread.start()
        try:
            self._tried.wait()
            yield
        finally:
            stop.set()
            thread.join(LEAVE_PATIENCE)
            self._close()

    def _run(self, stop: threading.Event) -> None:
        while not stop.is_set():
            pause = self._try()
            self._tried.set()
            stop.wait(pause)
        self._leave()

    def _try(self) -> float:
        """Dispatch once, whatever fails. Returns the seconds to wait."""
        try:
            return 0.0 if self.step() else self._interval
        except DatabaseDownError as error:
            self._heard_since = self._clock()
            self._report(str(error))
        except ServiceError as error:
            self._abandon()
            self._report(str(error))
            return self._interval
        except Exception as error:
            self._report(f"the dispatcher failed ({type(error).__name__}: {error})", trace=error)
        return RETRY

    def _report(self, fault: str, trace: Exception | None = None) -> None:
        """Log a fault, if it is new."""
        if fault != self.fault:
            logger.error("%s Retrying.", fault, exc_info=trace)
        self.fault = fault

    def step(self) -> bool:
        """Dispatch once. Returns whether this dispatcher has the lease.

        Raises ``DatabaseDownError``, and ``ServiceError`` if the executor is lost.
        """
        if self._clock() >= self._round and not self._begin_round():
            return False
        assert self._executor is not None
        for ended in self._executor.ended(WAIT):
            self._end(ended)
        while self._lost:
            self._claims.lose(*self._lost[0])
            del self._lost[0]
        while self._submit_next(self._executor):
            pass
        return True

    def _begin_round(self) -> bool:
        """Renew the lease, and look after what changes slowly. Returns whether the lease is ours."""
        now = self._clock()
        ahead = self._claims.now() - now
        if max(now - self._round, abs(ahead - self._ahead)) > self._silence / 2:
            self._heard_since = now  # we were frozen, the machine asleep, the database locked or its clock set
        self._ahead = ahead
        if not take_lease(self._claims.engine, DISPATCHER, holder=self._name, seconds=self._silence):
            self._abandon()
            self.fault = None
            return False
        if self._executor is None:
            logger.info("%s dispatches the jobs", self._name)
            self._executor = self._open()
        self._round = now + self._interval
        for job in self._claims.lose_unknown(self._held, "its worker or dispatcher died"):
            logger.warning("job %s was requeued: nobody runs it", job)
        self._cancel_dead(self._executor)
        workers = self._executor.workers()
        record_workers(self._claims.engine, workers)
        faults = [worker.fault for worker in workers if worker.fault is not None]
        self.fault = "; ".join(faults) if len(faults) == len(workers) > 0 else None
        self._claims.explain(self._executor.unmet(self._claims.waiting()))
        return True

    def _submit_next(self, executor: Executor) -> bool:
        """Submit the next job that fits. Returns whether there was one."""
        for needs in self._claims.upcoming():
            worker = executor.place(needs)
            claim = None if worker is None else self._claims.claim(needs, worker)
            if claim is not None:
                self._held[claim.job.id] = claim
                executor.submit(claim)
                return True
        return False

    def _end(self, ended: Ended) -> None:
        if self._held.get(ended.claim.job.id) == ended.claim:
            del self._held[ended.claim.job.id]
        if ended.reason is not None:
            self._lost.append((ended.claim, ended.reason))

    def _cancel_dead(self, executor: Executor) -> None:
        """Kill attempts that are frozen or make no progress. None is called dead after we were held up ourselves."""
        for lack, seconds, overdue in (
            ("heartbeat", self._silence, self._claims.silent),
            ("progress", self._stall_timeout, self._claims.still),
        ):
            if self._clock() - self._heard_since < seconds:
                continue
            for job, attempt in overdue(seconds).items():
                claim = self._held.get(job)
                if claim is not None and claim.attempt == attempt:
                    reason = f"no {lack} for {seconds:.0f} s on {claim.job.worker}"
                    logger.error("job %s: %s", job, reason)
                    executor.cancel(claim)
                    self._end(Ended(claim, reason))

    def _abandon(self) -> None:
        """Kill what runs: the executor is lost, or another dispatcher has the lease and the jobs."""
        self._held, self._round = {}, 0.0
        self._close()

    def _close(self) -> None:
        executor, self._executor = self._executor, None
        if executor is not None:
            with suppress(ServiceError):
                executor.close()

    def _leave(self) -> None:
        """Give the running jobs back and the lease up. An unreachable database is not waited for."""
        if self._executor is None:
            return
        try:
            for claim in self._held.values():
                with suppress(LostJobError, NotFoundError):
                    self._claims.give_back(claim)
            forget_workers(self._claims.engine)
            end_lease(self._claims.engine, DISPATCHER, holder=self._name)
        except DatabaseDownError as error:
            logger.warning("the dispatcher stops without giving its jobs back: %s", error)


@contextmanager
def dispatcher_name(folder: Path) -> Iterator[str]:
    """Hold the name of the dispatcher of a data folder: after a restart it has its lease still.

    While another process has the name, the name is a new one, which waits for the lease.
    """
    file = folder / "dispatcher"
    with ExitStack() as held:
        try:
            held.enter_context(exclusive(folder / "dispatcher.lock", "taken"))
        except ServiceError:
            yield _new_name()
            return
        name = file.read_text() if file.exists() else ""
        if not name:
            write_whole(file, (name := _new_name()).encode())
        yield name


def _new_name() -> str:
    return f"{socket.gethostname()}-{secrets.token_hex(4)}"
