"""The contract of executors, on the fake, on processes of this machine, and on a Ray cluster of three nodes."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fake_job import PHASES, trace
from tests.served import wait_until
from tests.service.executors import Executed
from trompe_shared.api import JobState


@pytest.fixture(params=["fake", "local", pytest.param("ray", marks=pytest.mark.cluster)])
def executed(request: pytest.FixtureRequest, tmp_path: Path, renderer: int) -> Iterator[Executed]:
    kind = request.getfixturevalue("cluster").address if request.param == "ray" else request.param
    queue = Executed(tmp_path, kind, renderer)
    yield queue
    queue.store.close()


def test_every_attempt_runs_once_and_its_end_is_recorded(executed: Executed) -> None:
    gates = [executed.submit("gate", seed=number) for number in range(3)]
    jobs = gates + [executed.submit("fine", seed=number) for number in range(3, 12)]
    with executed.dispatching():
        wait_until(lambda: all(executed.in_gate(job) for job in gates))  # one in each room
        for job in gates:
            executed.open_gate(job)
        ended = executed.ended(*jobs)
        assert len(executed.store.workers()) == 3
    assert {(job.state, job.attempts) for job in ended} == {(JobState.succeeded, 1)}
    assert len({job.worker for job in ended}) == 3
    for job in jobs:
        begun = [note for note in trace(executed.folder(job)) if note.startswith("begin")]
        assert begun == [f"begin {phase}" for phase in PHASES]


def test_an_attempt_that_dies_says_how_and_the_next_one_goes_on_until_the_third(executed: Executed) -> None:
    deadly, after = executed.submit("deadly"), executed.submit("fine")
    with executed.dispatching():
        died, fine = executed.ended(deadly, after)
    assert (died.state, died.attempts) == (JobState.failed, 3)
    assert re.search(r"3 workers died .* died \(", died.error or "")
    assert fine.state is JobState.succeeded


def test_the_next_job_is_that_of_the_highest_priority_among_all_that_fit(executed: Executed) -> None:
    sweeps = [executed.submit("fine", seed=number, priority="sweep", needs={"gpu": 1}) for number in range(3)]
    urgent = executed.submit("fine", priority="interactive", needs={"gpu": 1})
    large = executed.submit("fine", priority="interactive", needs={"gpu": 8})
    with executed.dispatching():
        executed.ended(*sweeps, urgent)
        started = {job: executed.state(job).started for job in (urgent, *sweeps)}
        note = wait_until(lambda: executed.state(large).note)
    assert sorted(started, key=lambda job: str(started[job])) == [urgent, *sweeps]
    assert executed.state(large).state is JobState.queued
    assert "no worker can meet its needs (cpu 1, gpu 8)" in note


def test_two_jobs_share_a_gpu_and_the_third_waits(executed: Executed) -> None:
    half = {"gpu": 0.5, "cpu": 0.1}
    first, second, third = (executed.submit("gate", seed=number, needs=half) for number in range(3))
    with executed.dispatching():
        wait_until(lambda: executed.in_gate(first) and executed.in_gate(second))
        place = executed.state(first).worker
        listed = next(worker for worker in executed.store.workers() if worker.id == place)
        assert first in listed.jobs
        assert executed.state(third).state is JobState.queued
        executed.open_gate(first)
        wait_until(lambda: executed.in_gate(third))
        for job in (second, third):
            executed.open_gate(job)
        assert {job.state for job in executed.ended(first, second, third)} == {JobState.succeeded}


def test_a_cancelled_job_leaves_its_room_to_the_next(executed: Executed) -> None:
    whole = {"gpu": 1}
    job, after = executed.submit("gate", needs=whole), executed.submit("fine", needs=whole)
    with executed.dispatching():
        wait_until(lambda: executed.in_gate(job))
        executed.store.request_cancel(job)
        cancelled, fine = executed.ended(job, after)
    assert (cancelled.state, fine.state) == (JobState.cancelled, JobState.succeeded)


def test_a_dispatcher_that_stops_gives_the_jobs_back_and_the_next_one_continues_them(executed: Executed) -> None:
    job = executed.submit("gate")
    with executed.dispatching():
        wait_until(lambda: executed.in_gate(job))
    assert executed.state(job).state is JobState.queued
    assert executed.store.workers() == []
    executed.open_gate(job)
    with executed.dispatching():
        (found,) = executed.ended(job)
    assert (found.state, found.attempts) == (JobState.succeeded, 2)
    assert trace(executed.folder(job)).count("begin prepare") == 1
