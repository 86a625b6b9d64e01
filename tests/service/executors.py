"""Queues of fake jobs for the contract tests of executors, and a fake executor."""

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

from tests.served import FAKE, Queue, wait_until
from trompe_server.executor.attempts import Attempts
from trompe_server.executor.dispatcher import Dispatcher
from trompe_server.executor.metrics import count
from trompe_server.executor.port import Ended, Executor, fits, left_in, too_much
from trompe_server.executor.process import Setup
from trompe_server.queue.claims import Claim, Claims
from trompe_server.queue.workers import Worker
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.service.dispatch import open_executor
from trompe_server.settings import Settings
from trompe_shared.api import Job, Needs

NAME: Final = "tests"


class FakeExecutor:
    """An ``Executor`` of threads with these ``rooms``. What would kill its process dies at once."""

    def __init__(self, setup: Setup, rooms: Sequence[Needs]) -> None:
        self._setup = setup
        self._rooms = {f"fake-{number}": room for number, room in enumerate(rooms)}
        self._threads = ThreadPoolExecutor(2 * len(rooms))
        self._running: dict[Future[str | None], Claim] = {}

    def place(self, needs: Needs) -> str | None:
        return next((name for name in self._rooms if fits(needs, self._left(name))), None)

    def submit(self, claim: Claim) -> None:
        deadly = claim.job.attack.goal.label == ["deadly"]
        run = (lambda: "it died (signal 9)") if deadly else partial(_attempts(self._setup).run, claim)
        self._running[self._threads.submit(run)] = claim

    def cancel(self, claim: Claim) -> None:
        self._running = {future: each for future, each in self._running.items() if each != claim}

    def ended(self, timeout: float) -> list[Ended]:
        if not self._running:
            time.sleep(timeout)
        done = wait(self._running, timeout, FIRST_COMPLETED).done
        return [Ended(self._running.pop(future), future.result()) for future in done]

    def workers(self) -> list[Worker]:
        return [Worker(name, "here", str(room)) for name, room in self._rooms.items()]

    def unmet(self, waiting: Mapping[Needs, int]) -> dict[Needs, str]:
        rooms = list(self._rooms.values())
        return {needs: too_much(needs, rooms) for needs in waiting if not any(fits(needs, room) for room in rooms)}

    def close(self) -> None:
        self._running = {}
        self._threads.shutdown(wait=False)

    def _left(self, name: str) -> Needs:
        return left_in(self._rooms[name], (claim for claim in self._running.values() if claim.job.worker == name))


@cache
def _attempts(setup: Setup) -> Attempts:
    return Attempts(setup.settings, setup.renderers, count_work=count)


class Executed(Queue):
    """A queue of fake jobs that a dispatcher hands to an executor of three cores and one GPU: a ``kind``, or Ray at
    its address."""

    def __init__(self, folder: Path, kind: str, renderer: int, **settings: Any) -> None:
        device = "cuda" if kind == "local" else "cpu"
        executor = "local" if kind == "fake" else kind
        fixed: dict[str, Any] = {"data": folder, "workers": 3, "device": device, "executor": executor}
        super().__init__(Settings(**fixed | settings, pipeline=FAKE["TROMPE_PIPELINE"]))
        self.store.migrate()
        self._fake = kind == "fake"
        self.setup = Setup(self.settings, RendererAddresses((("127.0.0.1", renderer),)))

    def open(self) -> Executor:
        if not self._fake:
            return open_executor(self.settings, self.setup.renderers, mark=NAME)
        return FakeExecutor(self.setup, [Needs(), Needs(), Needs(gpu=1)])

    @contextmanager
    def dispatching(self) -> Iterator[Dispatcher]:
        claims, limits = Claims(self.store.engine), self.settings
        dispatcher = Dispatcher(
            claims, self.open, name=NAME, silence=limits.silence, stall_timeout=limits.stall_timeout
        )
        with dispatcher.running():
            yield dispatcher

    def ended(self, *jobs: str) -> list[Job]:
        """The jobs, once they have ended."""
        wait_until(lambda: all(self.state(job).state.final for job in jobs))
        return [self.state(job) for job in jobs]
