"""How a worker runs a job, without processes: jobs of a few lines, and a database that fails on demand."""

import errno
import os
import re
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import Mock

import pytest

from tests.service.records import claim, claims_of, create
from trompe_server.executor.metrics import WORK, count
from trompe_server.executor.runner import JobRunner
from trompe_server.job.protocol import DamagedFileError, OnProgress, PhaseReport
from trompe_server.queue.claims import Claims, Ending
from trompe_server.queue.store import JobStore
from trompe_server.storage.database import DatabaseDownError
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import JobState, Progress

pytestmark = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)

T = TypeVar("T")
Phase = Callable[[OnProgress], None]


class Scripted:
    """A job whose phases are functions. ``ran`` lists the phases run. ``then``: phases to go on with."""

    def __init__(self, **phases: Phase) -> None:
        self._phases, self.ran, self.then = phases, list[str](), dict[str, str]()

    def phases(self) -> list[str]:
        return list(self._phases)

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        self.ran.append(phase)
        self._phases[phase](on_progress)
        fraction = (self.phases().index(phase) + 1) / len(self._phases)
        return PhaseReport(Progress(phase=phase, fraction=fraction), then=self.then.get(phase))


def nothing(_: OnProgress) -> None:
    """A phase that does nothing."""


def runner_of(claims: Claims, job: Scripted, **options: Any) -> JobRunner:
    """A runner that always opens ``job`` and retries at once."""
    return JobRunner(claims, lambda _: nullcontext(job), retry_waits=(0.001, 0.01), **options)


def run(store: JobStore, scripted: Scripted, *, claims: Claims | None = None, **options: Any) -> JobState | None:
    job = create(store)
    state = runner_of(claims or claims_of(store), scripted, **options).run(claim(store))
    assert state is None or store.get(job).state is state
    return state


def test_a_finished_phase_gives_way_to_the_name_of_the_next_one(store: JobStore) -> None:
    shown: list[str] = []

    def look(_: OnProgress) -> None:
        shown.append(store.page().jobs[0].progress.phase)

    run(store, Scripted(**{"prepare": look, "attack-000": look, "attack-001": look, "judge": look}))

    assert shown == ["queued", "attack", "attack", "judge"]


def test_progress_is_written_at_most_once_per_interval(store: JobStore) -> None:

    def eager(on_progress: OnProgress) -> None:
        for step in range(100):
            on_progress(Progress(phase="only", fraction=step / 100, step=step, steps=100))
            time.sleep(0.002)

    began = time.monotonic()
    run(store, Scripted(only=eager), progress_interval=0.05)
    intervals = (time.monotonic() - began) / 0.05
    (job,) = store.page().jobs
    assert 2 <= len([event for event in store.events(job.id) if event.progress.step]) <= 1 + intervals


class Deaf(Claims):
    """Claims whose every call fails twice: before the commit, and after it, so that the answer is lost."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.calls = 0

    def advance(self, *args: Any, **options: Any) -> bool:
        return self._deaf(lambda: super(Deaf, self).advance(*args, **options))

    def finish(self, *args: Any, **options: Any) -> list[str]:
        return self._deaf(lambda: super(Deaf, self).finish(*args, **options))

    def _deaf(self, call: Callable[[], T]) -> T:
        self.calls += 1
        if self.calls % 3 == 1:
            raise DatabaseDownError("not now")
        answer = call()
        if self.calls % 3 == 2:
            raise DatabaseDownError("the answer was lost")
        return answer


def test_a_database_that_goes_away_at_every_write_costs_time_alone(store: JobStore) -> None:
    pipeline = Scripted(a=nothing, b=nothing, c=nothing)
    assert run(store, pipeline, claims=Deaf(store.engine)) is JobState.succeeded
    assert pipeline.ran == ["a", "b", "c"]
    (job,) = store.page().jobs
    assert (job.attempts, job.progress.fraction) == (1, 1.0)
    assert len([event for event in store.events(job.id) if event.state.final]) == 1


def test_progress_that_cannot_be_written_stops_nothing(store: JobStore) -> None:

    def chatty(on_progress: OnProgress) -> None:
        for _ in range(4):
            on_progress(Progress(phase="only", fraction=0.5))

    assert run(store, Scripted(only=chatty), claims=Deaf(store.engine), progress_interval=0.0) is JobState.succeeded


def test_a_phase_that_finds_damage_has_the_one_before_run_again(
    store: JobStore, caplog: pytest.LogCaptureFixture
) -> None:
    needy = [DamagedFileError("a checksum is wrong"), None, None]
    pipeline = Scripted(a=nothing, b=Mock(side_effect=needy), c=Mock(side_effect=needy))
    assert run(store, pipeline) is JobState.succeeded
    assert pipeline.ran == ["a", "b", "a", "b", "c", "b", "c"]
    assert caplog.text.count("repeats the previous phase: a checksum is wrong") == 2


def test_damage_that_does_not_go_away_fails_the_job_with_its_words(store: JobStore) -> None:
    hopeless = Mock(side_effect=DamagedFileError("the disk is broken"))
    assert run(store, Scripted(a=nothing, b=hopeless)) is JobState.failed
    (job,) = store.page().jobs
    assert job.error == "the disk is broken"


def test_a_full_disk_is_told_in_words(store: JobStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    pipeline = Scripted(a=lambda _: LocalArtifacts(tmp_path / "job").write("state.npz", b"0"))
    assert run(store, pipeline) is JobState.failed
    (job,) = store.page().jobs
    assert re.search("no space left.*TROMPE_RETENTION_DAYS", job.error or "", re.DOTALL)
    assert list((tmp_path / "job").iterdir()) == []


def test_a_job_that_is_lost_unwinds_at_its_next_write(store: JobStore) -> None:
    def robbed(on_progress: OnProgress) -> None:
        assert claims.lose_unknown({}, "nobody runs it")
        on_progress(Progress(phase="a", fraction=0.5))
        pytest.fail("it went on")

    claims = claims_of(store)
    pipeline = Scripted(a=robbed, b=nothing)
    assert run(store, pipeline, claims=claims) is None
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
        other = claims_of(store)
        other.lose_unknown({}, "it was silent")
        taken = claim(store, "other")
        if meanwhile != "taken":
            other.finish(taken, Ending(JobState.succeeded, public=("result.json",)))
        if meanwhile == "deleted":
            store.delete(job)
        on_progress(Progress(phase="a", fraction=0.5))
        pytest.fail("it went on")

    tidied: list[list[str]] = []
    job = create(store)
    runner = runner_of(claims_of(store), Scripted(a=overtaken), tidy_job=lambda _, names: tidied.append(names))
    assert runner.run(claim(store)) is None
    assert tidied == kept


def test_phases_count_their_seconds_and_their_work_by_kind(store: JobStore) -> None:
    def sample(name: str, **labels: str) -> float:
        return WORK.get_sample_value(f"trompe_{name}_total", labels) or 0.0

    class Counting(Scripted):
        def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
            return replace(super().run(phase, on_progress), counts={"attack_steps": 5, "target_renders": 2})

    names = [("attack_steps", {}), ("target_renders", {}), ("phase_seconds", {"phase": "attack"})]
    before = [sample(name, **labels) for name, labels in names]
    run(store, Counting(**{"attack-000": lambda _: time.sleep(0.01), "attack-001": nothing}), count_work=count)
    steps, renders, seconds = (
        sample(*name, **labels) - old for (*name, labels), old in zip(names, before, strict=True)
    )
    assert (steps, renders) == (10, 4)
    assert 0.01 <= seconds < 100


def test_phases_that_a_job_has_no_need_of_are_left_out_and_damage_goes_back_to_the_last_that_ran(
    store: JobStore,
) -> None:
    damaged = [True]

    def needs(_: OnProgress) -> None:
        if damaged[0]:
            raise DamagedFileError("the end of the attack is gone")

    def mend(_: OnProgress) -> None:
        damaged[0] = len(job.ran) == 1

    job = Scripted(first=mend, second=needs, third=needs, last=needs)
    job.then["first"] = "last"
    assert run(store, job) is JobState.succeeded
    assert job.ran == ["first", "last", "third", "second", "first", "last"]
