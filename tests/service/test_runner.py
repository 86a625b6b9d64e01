"""How a worker runs a job, without processes: the pipeline is a few lines, the database one that fails on demand."""

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trompe_server import database
from trompe_server.database import DatabaseDownError, write
from trompe_server.jobs import heart as heart_module
from trompe_server.jobs import runner as runner_module
from trompe_server.jobs.desk import Claim, Ending, JobDesk, lose
from trompe_server.jobs.heart import Heart
from trompe_server.jobs.roll import WorkerRoll
from trompe_server.jobs.runner import JobRunner, OpenedJob
from trompe_server.jobs.store import JobStore
from trompe_server.jobs.tables import fresh
from trompe_server.meter import Meter
from trompe_server.pipeline import DamagedFileError, OnProgress, PhaseReport
from trompe_shared.api import JobRequest, JobState, Progress
from trompe_shared.errors import RendererError

Phase = Callable[[OnProgress], None]


class Scripted:
    """A pipeline whose phases are functions; a phase that was run is noted in ``ran``."""

    def __init__(self, **phases: Phase) -> None:
        self._phases, self.ran = phases, list[str]()

    def phases(self) -> list[str]:
        return list(self._phases)

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        self.ran.append(phase)
        self._phases[phase](on_progress)
        return PhaseReport(Progress(phase=phase, fraction=(self.phases().index(phase) + 1) / len(self._phases)))


def nothing(_: OnProgress) -> None:
    """A phase that does nothing."""


@pytest.fixture
def store(tmp_path: Path) -> Iterator[JobStore]:
    store = JobStore(f"sqlite:///{tmp_path / 'trompe.sqlite'}")
    store.migrate()
    yield store
    store.close()


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "PATIENCE", (0.001, 0.01))


def run(store: JobStore, pipeline: Scripted, *, desk: JobDesk | None = None) -> JobState | None:
    """Submit a job and run it."""
    job = store.create(JobRequest.model_validate({"object": "mug", "label": "mug"}))[0].id
    runner = JobRunner(desk or JobDesk(store.engine, "w"), lambda _: OpenedJob(pipeline, lambda: None))
    claim = runner.desk.claim(("any",))
    assert claim is not None
    state = runner.run(claim)
    assert runner.current is None
    assert state is None or store.get(job).state is state
    return state


def test_progress_is_written_once_a_second_at_most_and_tells_how_long_it_takes(
    store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner_module, "PROGRESS_INTERVAL", 0.05)

    def eager(on_progress: OnProgress) -> None:
        for step in range(100):
            on_progress(Progress(phase="only", fraction=step / 100, step=step, steps=100))
            time.sleep(0.002)

    began = time.monotonic()
    run(store, Scripted(only=eager))
    intervals = (time.monotonic() - began) / 0.05
    (job,) = store.page().jobs
    told = [event.progress for event in store.events(job.id) if event.progress.step]
    assert 2 <= len(told) <= 1 + intervals
    assert all(progress.eta_seconds is not None for progress in told[1:])
    assert told[-1].eta_seconds < told[1].eta_seconds  # type: ignore[operator]


class Deaf(JobDesk):
    """A desk whose every call fails twice: once before it is done, once after, so that its answer is lost."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.calls = 0

    def advance(self, *args: Any, **options: Any) -> bool:
        return self._deaf(lambda: super(Deaf, self).advance(*args, **options))

    def finish(self, *args: Any, **options: Any) -> list[str]:
        kept: list[str] = self._deaf(lambda: super(Deaf, self).finish(*args, **options))
        return kept

    def _deaf(self, call: Callable[[], Any]) -> Any:
        self.calls += 1
        if self.calls % 3 == 1:
            raise DatabaseDownError("not now")
        answer = call()
        if self.calls % 3 == 2:
            raise DatabaseDownError("the answer was lost")
        return answer


def test_a_database_that_goes_away_at_every_write_costs_time_alone(store: JobStore) -> None:
    pipeline = Scripted(a=nothing, b=nothing, c=nothing)
    assert run(store, pipeline, desk=Deaf(store.engine, "w")) is JobState.succeeded
    assert pipeline.ran == ["a", "b", "c"]
    (job,) = store.page().jobs
    assert (job.attempts, job.progress.fraction) == (1, 1.0)
    assert len([event for event in store.events(job.id) if event.state.final]) == 1


def test_progress_that_cannot_be_written_stops_nothing(store: JobStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner_module, "PROGRESS_INTERVAL", 0.0)

    def chatty(on_progress: OnProgress) -> None:
        for _ in range(4):
            on_progress(Progress(phase="only", fraction=0.5))

    assert run(store, Scripted(only=chatty), desk=Deaf(store.engine, "w")) is JobState.succeeded


def test_a_phase_that_finds_damage_has_the_one_before_run_again(store: JobStore) -> None:
    broken = {"c": 1, "b": 1}

    def needy(name: str) -> Phase:
        def phase(_: OnProgress) -> None:
            if broken.get(name):
                broken[name] -= 1
                raise DamagedFileError("a checksum is wrong")

        return phase

    pipeline = Scripted(a=nothing, b=needy("b"), c=needy("c"))
    assert run(store, pipeline) is JobState.succeeded
    assert pipeline.ran == ["a", "b", "a", "b", "c", "b", "c"]


def test_damage_that_does_not_go_away_fails_the_job_with_its_words(store: JobStore) -> None:
    def hopeless(_: OnProgress) -> None:
        raise DamagedFileError("the disk is broken")

    assert run(store, Scripted(a=nothing, b=hopeless)) is JobState.failed
    (job,) = store.page().jobs
    assert job.error == "the disk is broken"


def test_a_phase_that_loses_the_renderer_is_run_once_more(store: JobStore) -> None:
    lost = iter([True, False])

    def fragile(_: OnProgress) -> None:
        if next(lost):
            raise RendererError("it went away")

    pipeline = Scripted(a=fragile)
    assert run(store, pipeline) is JobState.succeeded
    assert pipeline.ran == ["a", "a"]


def test_a_full_disk_is_told_in_words(store: JobStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import errno
    import os

    from trompe_server.artifacts import LocalArtifacts

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    pipeline = Scripted(a=lambda _: LocalArtifacts(tmp_path / "job").write("state.npz", b"0"))
    assert run(store, pipeline) is JobState.failed
    (job,) = store.page().jobs
    assert job.error is not None
    assert "no space left" in job.error
    assert "TROMPE_RETENTION_DAYS" in job.error
    assert list((tmp_path / "job").iterdir()) == []


def test_a_job_that_is_lost_unwinds_at_its_next_step(store: JobStore) -> None:
    def robbed(on_progress: OnProgress) -> None:
        roll = WorkerRoll(store.engine, "w", device="cpu")
        roll.arrive()  # as if another process had come up under this name
        heart.beat()
        on_progress(Progress(phase="a", fraction=0.5))
        pytest.fail("it went on")

    pipeline = Scripted(a=robbed, b=nothing)
    store.create(JobRequest.model_validate({"object": "mug", "label": "mug"}))
    runner = JobRunner(JobDesk(store.engine, "w"), lambda _: OpenedJob(pipeline, lambda: None))
    heart = Heart(WorkerRoll(store.engine, "w", device="cpu"), runner, Meter(), silence=30)
    claim = runner.desk.claim(("any",))
    assert claim is not None
    assert runner.run(claim) is None
    assert pipeline.ran == ["a"]
    assert store.counts()[JobState.queued] == 1


@pytest.mark.parametrize(
    ("meanwhile", "kept"),
    [
        pytest.param("taken", [], id="goes on elsewhere"),
        pytest.param("ended", [["result.json"]], id="has ended"),
        pytest.param("deleted", [[]], id="was deleted"),
    ],
)
def test_a_lost_attempt_tidies_up_after_itself_where_nobody_else_will(
    store: JobStore, meanwhile: str, kept: list[list[str]]
) -> None:
    def overtaken(on_progress: OnProgress) -> None:
        with write(store.engine) as connection:
            lose(connection, fresh(connection, job), "it was silent")
        other = JobDesk(store.engine, "other")
        taken = other.claim(("any",))
        assert taken is not None
        if meanwhile != "taken":
            other.finish(taken, Ending(JobState.succeeded, public=("result.json",)))
        if meanwhile == "deleted":
            store.delete(job)
        on_progress(Progress(phase="a", fraction=0.5))
        pytest.fail("it went on")

    tidied: list[list[str]] = []
    job = store.create(JobRequest.model_validate({"object": "mug", "label": "mug"}))[0].id
    pipeline = Scripted(a=overtaken)
    runner = JobRunner(
        JobDesk(store.engine, "w"), lambda _: OpenedJob(pipeline, lambda: None), lambda _, names: tidied.append(names)
    )
    claim = runner.desk.claim(("any",))
    assert claim is not None
    assert runner.run(claim) is None
    assert tidied == kept


def test_nobody_is_called_dead_right_after_all_were_held_up(store: JobStore, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0

    class HeldUp(WorkerRoll):
        """The database is locked during the beat at 35 s."""

        def beat(self, job: str | None, done: Mapping[str, float]) -> None:
            nonlocal now
            now += 20.0 if now == 35.0 else 0.0
            super().beat(job, done)

    monkeypatch.setattr(heart_module, "time", SimpleNamespace(monotonic=lambda: now))
    job = store.create(JobRequest.model_validate({"object": "mug", "label": "mug"}))[0].id
    heart = Heart(
        HeldUp(store.engine, "w", device="cpu"), JobRunner(JobDesk(store.engine, "w"), _nothing), Meter(), silence=30
    )
    while now < 30.0:
        now += 5.0
        heart.beat()
    assert JobDesk(store.engine, "never seen").claim(("any",)) is not None
    now = 35.0
    heart.beat()
    assert store.get(job).state is JobState.running, "the other one could not be heard, either"
    while now < 90.0:
        now += 5.0
        heart.beat()
    assert store.get(job).state is JobState.queued


def _nothing(_: Claim) -> OpenedJob:
    raise AssertionError("there is nothing to open")


def test_what_was_done_is_counted() -> None:
    import torch

    from trompe_server.classifiers.metered import meter_network
    from trompe_server.meter import MeteredPipeline

    def steps(on_progress: OnProgress) -> None:
        for step in (1, 1, 2, 3):
            on_progress(Progress(phase="a", fraction=0.5, step=step))

    meter, network = Meter(), torch.nn.Linear(4, 2)
    meter_network(network, meter)
    MeteredPipeline(Scripted(a=steps), meter).run("a", lambda _: None)
    images = torch.zeros(5, 4, requires_grad=True)
    network(images).sum().backward()
    with torch.no_grad():
        network(images)
    counted = meter.take()
    assert (counted["attack_steps"], counted["classifier_images"]) == (3, 10)
    assert counted["classifier_seconds"] > 0
    assert counted["step_seconds"] > 0
    assert meter.take() == {}
