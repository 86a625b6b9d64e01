"""A real worker process on a real database, with a fake pipeline: what happens to jobs when things go wrong."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from trompe_server.jobs.engine import DbosQueue
from trompe_server.jobs.fake import PHASES, trace
from trompe_server.jobs.store import JobStore
from trompe_server.jobs.worker import prepare_data
from trompe_server.settings import Settings
from trompe_shared.api import Job, JobSpec, JobState


def wait_until(condition: Callable[[], Any], *, seconds: float = 60.0) -> Any:
    """What ``condition`` returns once it is true; fails after ``seconds``."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)
    return value


@contextmanager
def listening() -> Iterator[int]:
    """A port that accepts connections and never says anything: enough of a renderer for a fake pipeline."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


class WorkerProcess:
    """A real attack worker that runs fake pipelines."""

    def __init__(self, data: Path, renderer: int, **environment: str) -> None:
        command = ["worker", "--data", str(data), "--renderer", f"127.0.0.1:{renderer}"]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "trompe_server.jobs.leash", *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"TROMPE_PIPELINE": "trompe_server.jobs.fake:open_pipeline"} | environment,
        )

    def ready(self) -> "WorkerProcess":
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "trompe worker ready\n"
        return self

    def end(self, number: signal.Signals) -> int:
        """Send a signal and return the exit status."""
        self.process.send_signal(number)
        return self.process.wait(60)

    def words(self) -> str:
        """What the process, which has ended, said on standard error."""
        assert self.process.stderr is not None
        return self.process.stderr.read()

    def close(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            assert pipe is not None
            pipe.close()


@contextmanager
def worker(data: Path, renderer: int, **environment: str) -> Iterator[WorkerProcess]:
    """A worker that takes jobs, for the time of the block."""
    running = WorkerProcess(data, renderer, **environment)
    try:
        yield running.ready()
    finally:
        running.end(signal.SIGKILL)
        running.close()


class Service:
    """The API's side of a data folder."""

    def __init__(self, data: Path) -> None:
        self.settings = Settings(data=data)
        prepare_data(self.settings)
        self.store, self.queue = JobStore(self.settings.database), DbosQueue(self.settings.database)

    def submit(self, label: str) -> str:
        return self.store.create(JobSpec.model_validate({"object": "mug", "label": label}), self.queue.enqueue).id

    def state(self, job: str) -> JobState:
        return self.store.get(job).state

    def ended(self, job: str) -> Job:
        wait_until(lambda: self.state(job).final)
        return self.store.get(job)

    def folder(self, job: str) -> Path:
        return self.settings.artifacts(job)

    def in_gate(self, job: str) -> bool:
        return self.store.get(job).progress.phase == "attack-001"

    def open_gate(self, job: str) -> None:
        (self.folder(job) / "go").touch()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    yield service
    service.queue.close()
    service.store.close()


@pytest.fixture
def renderer() -> Iterator[int]:
    with listening() as port:
        yield port


def test_jobs_run_one_after_the_other_and_each_ends_as_its_pipeline_says(service: Service, renderer: int) -> None:
    labels = ["fine", "hopeless", "broken", "bug", "no object", "flaky renderer"]
    jobs = {label: service.submit(label) for label in labels}
    with worker(service.settings.data, renderer):
        ended = {label: service.ended(job) for label, job in jobs.items()}

    assert {label: job.state for label, job in ended.items()} == {
        "fine": JobState.succeeded,
        "hopeless": JobState.not_applicable,
        "broken": JobState.failed,
        "bug": JobState.failed,
        "no object": JobState.failed,
        "flaky renderer": JobState.succeeded,
    }
    assert ended["fine"].artifacts == ["result.json", "judge.txt"]
    assert ended["fine"].progress.fraction == 1.0
    assert ended["hopeless"].note == "no view was recognised"
    assert ended["broken"].error == "The object is broken; mend it."
    assert ended["bug"].error == "An unexpected error ended the job: ZeroDivisionError: a mistake of ours"
    assert ended["no object"].error == "The object went away."
    assert all(job.attempts == 1 for job in ended.values())
    starts = [ended[label].started for label in labels]
    assert starts == sorted(starts)  # type: ignore[type-var]
    for label in ("broken", "bug"):
        assert trace(service.folder(jobs[label])).count("begin attack-001") == 1, "failing phases are not tried again"


def test_a_job_whose_worker_is_killed_goes_on_at_its_last_phase(service: Service, renderer: int) -> None:
    job, after = service.submit("gate"), service.submit("fine")
    with worker(service.settings.data, renderer) as first:
        wait_until(lambda: service.in_gate(job))
        first.end(signal.SIGKILL)
    assert service.state(job) is JobState.running

    service.open_gate(job)
    with worker(service.settings.data, renderer):
        found = service.ended(job)
        service.ended(after)

    assert (found.state, found.attempts) == (JobState.succeeded, 2)
    notes = trace(service.folder(job))
    assert [note for note in notes if note.startswith("end")] == [f"end {phase}" for phase in PHASES]
    assert notes.count("begin prepare") == notes.count("begin attack-000") == 1
    assert notes.count("begin attack-001") == 2
    messages = [event.message for event in service.store.events(job) if event.message]
    assert messages == ["queued", "started", "goes on after an interruption"]


def test_a_job_that_kills_three_workers_is_failed_and_the_next_job_runs(service: Service, renderer: int) -> None:
    job, after = service.submit("deadly"), service.submit("fine")
    for _ in range(3):
        with worker(service.settings.data, renderer) as running:
            assert running.process.wait(60) == -signal.SIGKILL
    with worker(service.settings.data, renderer):
        found = service.ended(job)
        assert service.ended(after).state is JobState.succeeded

    assert found.state is JobState.failed
    assert found.error is not None
    assert "3 workers died" in found.error
    assert found.attempts == 3


def test_a_worker_that_is_asked_to_stop_gives_its_job_back_unharmed(service: Service, renderer: int) -> None:
    job = service.submit("gate")
    for _ in range(4):
        with worker(service.settings.data, renderer) as running:
            wait_until(lambda: service.in_gate(job) and service.state(job) is JobState.running)
            assert running.end(signal.SIGTERM) == 0
        assert service.state(job) is JobState.queued
    service.open_gate(job)
    with worker(service.settings.data, renderer):
        assert service.ended(job).state is JobState.succeeded


def test_cancelling_stops_a_running_job_within_its_phase_and_a_queued_one_at_once(
    service: Service, renderer: int
) -> None:
    running, queued, after = service.submit("gate"), service.submit("fine"), service.submit("fine")
    with worker(service.settings.data, renderer) as process:
        wait_until(lambda: service.in_gate(running))
        assert service.store.request_cancel(queued).state is JobState.cancelled
        service.queue.forget(queued)
        assert service.store.request_cancel(running).state is JobState.running
        assert service.ended(running).state is JobState.cancelled
        assert service.ended(after).state is JobState.succeeded
        process.end(signal.SIGKILL)
        words = process.words()

    assert trace(service.folder(queued)) == []
    assert "end attack-001" not in trace(service.folder(running))
    assert "Traceback" not in words


def test_a_job_cancelled_while_its_worker_is_dead_is_cancelled_by_the_next(service: Service, renderer: int) -> None:
    job = service.submit("gate")
    with worker(service.settings.data, renderer) as running:
        wait_until(lambda: service.in_gate(job))
        running.end(signal.SIGKILL)
    service.store.request_cancel(job)
    with worker(service.settings.data, renderer):
        assert service.ended(job).state is JobState.cancelled
    assert trace(service.folder(job)).count("begin attack-001") == 1


def test_a_job_that_stands_still_costs_its_worker_the_job(service: Service, renderer: int) -> None:
    job = service.submit("silent")
    with worker(service.settings.data, renderer, TROMPE_STALL_TIMEOUT="1") as running:
        assert running.process.wait(60) == 75
    assert service.state(job) is JobState.running


def test_a_job_fails_with_a_remedy_where_no_renderer_answers(service: Service) -> None:
    with listening() as port:
        pass
    job = service.submit("fine")
    with worker(service.settings.data, port, TROMPE_RENDERER_PATIENCE="0.5"):
        found = service.ended(job)
    assert found.state is JobState.failed
    assert found.error is not None
    assert f"No renderer answers at 127.0.0.1:{port}" in found.error
    assert "trompe render" in found.error


def test_a_second_worker_on_the_same_data_is_refused(service: Service, renderer: int) -> None:
    with worker(service.settings.data, renderer):
        second = WorkerProcess(service.settings.data, renderer)
        assert second.process.wait(60) == 1
    assert "Another worker runs on" in second.words()
    second.close()


def test_a_worker_ends_with_its_parent(service: Service, renderer: int) -> None:
    with worker(service.settings.data, renderer) as running:
        assert running.process.stdin is not None
        running.process.stdin.close()
        assert running.process.wait(20) == 0
