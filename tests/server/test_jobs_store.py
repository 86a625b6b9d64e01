"""The record of jobs, without any engine."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from trompe_server.errors import NotFoundError
from trompe_server.jobs.runner import JobRunner, OpenedJob, Outcome
from trompe_server.jobs.store import JobStore
from trompe_server.pipeline import OnProgress, PhaseReport
from trompe_shared.api import JobSpec, JobState, Progress

SPEC = JobSpec.model_validate({"object": "mug", "label": "mug"})


@pytest.fixture
def store(tmp_path: Path) -> Iterator[JobStore]:
    store = JobStore(tmp_path / "jobs.sqlite")
    store.migrate()
    yield store
    store.close()


def create(store: JobStore) -> str:
    return store.create(SPEC, lambda _connection, _job: None).id


def test_a_job_that_cannot_be_queued_is_not_kept(store: JobStore) -> None:
    def refuse(_connection: sa.Connection, _job: str) -> None:
        raise RuntimeError("the queue is closed")

    with pytest.raises(RuntimeError):
        store.create(SPEC, refuse)
    assert store.page().jobs == []


def test_an_unknown_job_is_refused(store: JobStore) -> None:
    with pytest.raises(NotFoundError, match="no job 'x'"):
        store.get("x")


def test_a_job_that_has_ended_never_changes_again(store: JobStore) -> None:
    job = create(store)
    store.begin(job)
    store.finish(job, JobState.succeeded, note="done")
    ended = store.get(job)
    assert store.begin(job) is None
    store.finish(job, JobState.failed, error="too late")
    store.give_back(job)
    store.request_cancel(job)
    assert store.get(job) == ended


def test_a_job_given_back_does_not_count_as_lost(store: JobStore) -> None:
    job = create(store)
    for _ in range(5):
        assert store.begin(job) is not None
        store.give_back(job)
    assert store.begin(job) is not None
    assert store.get(job).attempts == 6


def test_event_ids_grow_by_one_however_many_write_at_once(store: JobStore) -> None:
    job = create(store)
    store.begin(job)
    progress = Progress(phase="attack", fraction=0.5)
    threads = [threading.Thread(target=lambda: [store.advance(job, progress) for _ in range(5)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [event.id for event in store.events(job)] == list(range(1, 23))
    assert [event.id for event in store.events(job, after=20)] == [21, 22]


def test_progress_is_written_at_most_four_times_a_second_and_survives_a_database_that_is_down(
    store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Eager:
        def phases(self) -> list[str]:
            return ["only"]

        def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
            for step in range(1000):
                on_progress(Progress(phase=phase, fraction=step / 1000))
            return PhaseReport(Progress(phase=phase, fraction=1.0), state=JobState.succeeded)

    calls = 0
    advance = JobStore.advance

    def advance_after_outage(self: JobStore, job: str, progress: Progress, *, public: tuple[str, ...] = ()) -> bool:
        nonlocal calls
        calls += 1
        if calls == 1:
            raise sa.exc.OperationalError("UPDATE", {}, Exception("database is locked"))
        return advance(self, job, progress, public=public)

    monkeypatch.setattr(JobStore, "advance", advance_after_outage)

    def step(_name: str, phase: object) -> Outcome:
        assert callable(phase)
        outcome: Outcome = phase()
        return outcome

    job = create(store)
    runner = JobRunner(store, lambda _job: OpenedJob(Eager(), lambda: None))
    assert runner.run(job, step) == "succeeded"
    assert 2 <= calls < 20
    assert runner.current is None
