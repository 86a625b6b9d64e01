"""Real attack workers that run fake pipelines, and the API's side of what they work on."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from trompe_server.artifacts import JobArtifacts, job_artifacts, open_folder
from trompe_server.jobs.store import JobStore
from trompe_server.jobs.worker import prepare_data
from trompe_server.settings import Settings
from trompe_shared.api import Job, JobRequest, JobState

FAKE = "trompe_server.jobs.fake:open_pipeline"


def wait_until(condition: Callable[[], Any], *, seconds: float = 60.0, story: Callable[[], str] = str) -> Any:
    """What ``condition`` returns once it is true; fails after ``seconds`` with ``story``."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {seconds:.0f} s in vain\n{story()}"
        time.sleep(0.02)
    return value


@contextmanager
def listening() -> Iterator[int]:
    """A port that accepts connections and never says anything: enough of a renderer for a fake pipeline."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@contextmanager
def serving(
    data: Path, *options: str, log: Path, environment: Mapping[str, str]
) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """``trompe serve`` for the time of the block: its process, and its URL. What it says goes to ``log``."""
    command = [sys.executable, "-m", "trompe_server.jobs.leash", "serve", "--port", "0", "--data", str(data), *options]
    pipe, own = subprocess.PIPE, os.environ | environment
    with (
        log.open("wb") as words,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=words, text=True, env=own) as process,
    ):
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("trompe serving on http://127.0.0.1:"), log.read_text()
        try:
            yield process, line.split()[-1]
        finally:
            process.terminate()


class WorkerProcess:
    """A worker of ``settings``, whose log goes to a file."""

    def __init__(self, settings: Settings, renderers: list[str], **environment: str) -> None:
        self.log = settings.data / f"worker-{time.monotonic_ns()}.log"
        settings.data.mkdir(parents=True, exist_ok=True)
        own = {
            "TROMPE_PIPELINE": FAKE,
            "TROMPE_DATA": str(settings.data),
            "TROMPE_DATABASE": settings.database_url,
            "TROMPE_STORE": settings.store_url,
            "TROMPE_SILENCE": str(settings.silence),
        }
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "trompe_server.jobs.leash", "worker", *renderers],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=os.environ | own | environment,
            )

    def ready(self) -> "WorkerProcess":
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line == "trompe worker ready\n", self.words()
        return self

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self, number: signal.Signals) -> int:
        """Send a signal and return the exit status."""
        self.send(number)
        return self.process.wait(60)

    def words(self) -> str:
        """What the process has said on standard error."""
        return self.log.read_text()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


class Service:
    """The API's side, and workers on demand."""

    def __init__(self, settings: Settings, renderer: int) -> None:
        self.settings, self.renderer = settings, renderer
        prepare_data(settings)
        self.store = JobStore(settings.database_url)

    @contextmanager
    def worker(self, *, renderers: list[str] | None = None, **environment: str) -> Iterator[WorkerProcess]:
        """A worker that takes jobs, for the time of the block."""
        running = WorkerProcess(self.settings, renderers or ["--renderer", f"127.0.0.1:{self.renderer}"], **environment)
        try:
            yield running.ready()
        finally:
            running.close()

    def submit(self, label: str, **options: Any) -> str:
        request = JobRequest.model_validate({"object": "mug", "label": label} | options)
        return self.store.create(request)[0].id

    def state(self, job: str) -> JobState:
        return self.store.get(job).state

    def ended(self, job: str, *, seconds: float = 60.0) -> Job:
        wait_until(lambda: self.state(job).final, seconds=seconds)
        return self.store.get(job)

    def artifacts(self, job: str) -> JobArtifacts:
        return job_artifacts(open_folder(self.settings.store_url), job)

    def folder(self, job: str) -> Path:
        return Path(self.settings.store_url) / "jobs" / job

    def in_gate(self, job: str) -> bool:
        found = self.store.get(job)
        return found.state is JobState.running and found.progress.phase == "attack-001"

    def open_gate(self, job: str) -> None:
        (self.folder(job) / "go").touch()

    def close(self) -> None:
        self.store.close()
