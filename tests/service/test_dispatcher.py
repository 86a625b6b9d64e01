"""The dispatcher on the fake executor: leases, losses, and executors that fail."""

import errno
import os
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.served import FAKE, process_table, wait_until, workers_of
from tests.service.executors import Executed
from trompe_server.errors import ServiceError
from trompe_server.executor.dispatcher import Dispatcher, dispatcher_name
from trompe_server.executor.local import LocalExecutor
from trompe_server.executor.port import Ended, Executor
from trompe_server.executor.process import Setup
from trompe_server.queue.claims import START_ALLOWANCE, Claim, Claims
from trompe_server.queue.tables import events, jobs
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings
from trompe_server.storage.database import DatabaseDownError, write
from trompe_shared.api import JobState, Needs


class Clock:
    """A clock set by hand."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def executed(tmp_path: Path, renderer: int) -> Iterator[Executed]:
    queue = Executed(tmp_path, "fake", renderer)
    yield queue
    queue.store.close()


def dispatcher(
    executed: Executed, open: Callable[[], Executor], *, stall_timeout: float = 60
) -> tuple[Dispatcher, Clock]:
    clock, claims = Clock(), Claims(executed.store.engine)
    return Dispatcher(claims, open, name="ours", silence=30, stall_timeout=stall_timeout, clock=clock), clock


def frozen(executed: Executed) -> Executor:
    """An executor whose attempts never begin."""
    executor = executed.open()
    executor.submit = lambda claim: None  # type: ignore[method-assign]
    return executor


def test_an_attempt_that_never_begins_is_lost_long_before_the_stall_timeout(executed: Executed) -> None:
    job = executed.submit("fine")
    ours, clock = dispatcher(executed, lambda: frozen(executed), stall_timeout=1800)
    ours.step()
    for seconds in (START_ALLOWANCE, 31):
        assert executed.state(job).attempts == 1
        with write(executed.store.engine) as connection:
            connection.execute(jobs.update().values(seen=jobs.c.seen - seconds))
        for _ in range(6):
            clock.now += 6
            ours.step()
    assert "no heartbeat for 30 s" in "".join(event.message or "" for event in executed.store.events(job))
    assert executed.state(job).attempts == 2


def test_a_job_that_stands_still_is_lost_but_not_right_after_the_dispatcher_was_held_up(executed: Executed) -> None:
    job = executed.submit("fine")
    ours, clock = dispatcher(executed, lambda: frozen(executed))
    ours.step()
    with write(executed.store.engine) as connection:
        connection.execute(events.update().values(time=events.c.time - 100))
    clock.now += 50  # the machine was asleep
    ours.step()
    for _ in range(9):
        clock.now += 6
        ours.step()
        assert executed.state(job).attempts == 1
    clock.now += 10
    ours.step()
    assert "no progress for 60 s" in "".join(event.message or "" for event in executed.store.events(job))
    assert executed.state(job).attempts == 2


@pytest.mark.parametrize("hours", [1, -1])
def test_no_attempt_is_lost_when_the_clock_is_set(executed: Executed, hours: int) -> None:
    job = executed.submit("fine")
    ours, clock = dispatcher(executed, lambda: frozen(executed))
    for _ in range(6):
        ours.step()
        clock.now += 6
    with write(executed.store.engine) as connection:  # its last sign of life, as the new time sees it
        connection.execute(jobs.update().values(seen=jobs.c.seen - START_ALLOWANCE - 3600))
    now = ours._claims.now
    ours._claims.now = lambda: now() + 3600 * hours  # type: ignore[method-assign]
    for _ in range(5):
        clock.now += 6
        ours.step()
        assert executed.state(job).attempts == 1


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (FileExistsError(17, "File exists", "metrics"), "FileExistsError"),
        (DatabaseDownError("The database is not available (database or disk is full)."), "disk is full"),
    ],
)
def test_a_dispatcher_that_fails_says_so_until_it_works(executed: Executed, error: Exception, told: str) -> None:
    ours, _ = dispatcher(executed, Mock(side_effect=[error, executed.open()]))
    with ours.running():
        assert told in (ours.fault or "")
        wait_until(lambda: ours.fault is None)


@pytest.mark.parametrize("away", [DatabaseDownError("It is away."), PermissionError("It is away.")])
def test_an_outage_is_logged_once(executed: Executed, caplog: pytest.LogCaptureFixture, away: Exception) -> None:
    ours, _ = dispatcher(executed, Mock(side_effect=[away, away, executed.open()]))
    for _ in range(3):
        ours._try()
    assert (caplog.text.count("Retrying"), ours.fault) == (1, None)


def test_an_executor_that_is_lost_is_opened_again_and_the_jobs_go_on(executed: Executed) -> None:
    opened: list[Executor] = []

    def open_executor() -> Executor:
        if len(opened) == 1:
            opened.append(opened[0])
            raise ServiceError("No cluster answers.")
        opened.append(executed.open())
        return opened[-1]

    job = executed.submit("gate")
    claims = Claims(executed.store.engine)
    ours = Dispatcher(claims, open_executor, name="ours", silence=60, stall_timeout=60)
    with ours.running():
        wait_until(lambda: executed.in_gate(job))
        opened[0].ended = Mock(side_effect=ServiceError("The cluster was lost."))  # type: ignore[method-assign]
        wait_until(lambda: len(opened) == 3 and ours.fault is None)
        wait_until(lambda: executed.state(job).attempts == 2 and executed.in_gate(job))
        executed.open_gate(job)
        (found,) = executed.ended(job)
    assert (found.state, found.attempts) == (JobState.succeeded, 2)


def test_a_job_that_kills_its_dispatcher_is_failed_and_those_beside_it_end(executed: Executed) -> None:
    def open_executor() -> Executor:
        executor = executed.open()
        submit, ended, waiting = executor.submit, executor.ended, list[Claim]()

        def die_or_begin(timeout: float) -> list[Ended]:
            if any(claim.job.id == killer for claim in waiting):
                raise ServiceError("The machine died.")
            while waiting:
                submit(waiting.pop())
            return ended(timeout)

        executor.submit = waiting.append  # type: ignore[method-assign, assignment]
        executor.ended = die_or_begin  # type: ignore[method-assign]
        return executor

    fine = executed.submit("fine")
    killer = executed.submit("fine")
    jobs = [fine, killer, *(executed.submit("fine", seed=number) for number in range(3))]
    ours, _ = dispatcher(executed, open_executor)
    while not all(executed.state(job).state.final for job in jobs):
        try:
            ours.step()
        except ServiceError:
            ours, _ = dispatcher(executed, open_executor)
    assert {job for job in jobs if executed.state(job).state is not JobState.succeeded} == {killer}
    assert "10 dispatchers died" in str(executed.state(killer).error)


def freeze(worker: int) -> None:
    os.kill(worker, signal.SIGSTOP)


def kill_with_its_fork_server(worker: int) -> None:
    for pid in (process_table()[worker], worker):
        os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("harm", "silence", "told"), [(freeze, 4.0, "no heartbeat for 4 s"), (kill_with_its_fork_server, 60.0, " died (")]
)
def test_the_job_of_a_lost_process_goes_on_in_another(
    harm: Callable[[int], None], silence: float, told: str, tmp_path: Path, renderer: int
) -> None:
    executed = Executed(tmp_path, "local", renderer, silence=silence, workers=1)
    job, others = executed.submit("gate"), set(workers_of(os.getpid()))
    with executed.dispatching():
        wait_until(lambda: executed.in_gate(job))
        (worker,) = set(workers_of(os.getpid())) - others
        harm(worker)
        wait_until(lambda: executed.state(job).attempts == 2 and executed.in_gate(job))
        assert told in "".join(event.message or "" for event in executed.store.events(job))
        executed.open_gate(job)
        (ended,) = executed.ended(job)
    executed.store.close()
    assert ended.state is JobState.succeeded


def test_a_process_that_dies_before_it_is_ready_is_a_fault_and_is_tried_again(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, workers=1, store="nowhere://at.all", pipeline=FAKE["TROMPE_PIPELINE"])
    executor = LocalExecutor(Setup(settings, RendererAddresses()))
    try:
        wait_until(lambda: executor.ended(0.1) == [] and "2 times" in str(executor.workers()[0].fault))
    finally:
        executor.close()


def test_a_process_that_finds_no_file_descriptor_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = set(workers_of(os.getpid()))
    executor = LocalExecutor(Setup(Settings(data=tmp_path, workers=1), RendererAddresses()))
    with closing(executor), monkeypatch.context() as patched:
        wait_until(lambda: executor.ended(0.1) == [] and executor.place(Needs()) is not None)
        patched.setattr("multiprocessing.Pipe", Mock(side_effect=OSError(errno.EMFILE, "Too many open files")))
        (worker,) = set(workers_of(os.getpid())) - others
        os.kill(worker, signal.SIGKILL)
        wait_until(lambda: executor.ended(0.1) == [] and "Too many open files" in str(executor.workers()[0].fault))
        patched.undo()
        wait_until(lambda: executor.ended(0.1) == [] and executor.workers()[0].fault is None)


def test_a_fork_server_that_dies_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("trompe_server.executor.local.fork", Mock(side_effect=EOFError("unexpected EOF")))
    LocalExecutor(Setup(Settings(data=tmp_path), RendererAddresses())).close()
    wait_until(lambda: len(caplog.records) == 1)
    assert "died (unexpected EOF)" in caplog.text
    assert caplog.records[0].exc_info is None


def test_a_stop_does_not_wait_for_a_process_that_is_starting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = threading.Event()
    monkeypatch.setattr("trompe_server.executor.local.fork", lambda *_: started.wait())
    closing = threading.Thread(target=LocalExecutor(Setup(Settings(data=tmp_path), RendererAddresses())).close)
    closing.start()
    closing.join(60)
    assert not closing.is_alive()
    started.set()


def test_a_data_folder_keeps_its_dispatcher_s_name_and_lends_it_to_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with dispatcher_name(tmp_path) as first, dispatcher_name(tmp_path) as second:
        assert first != second
    with dispatcher_name(tmp_path) as again:
        assert again == first
    (tmp_path / "dispatcher").write_bytes(b"")
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr(tempfile, "mkstemp", full)
    with pytest.raises(ServiceError, match=f"no space left at {tmp_path}"), dispatcher_name(tmp_path):
        pass
