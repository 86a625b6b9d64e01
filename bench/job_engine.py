"""What a job costs apart from its attack: python -m bench.job_engine [--jobs N] [--workers N] [--executor NAME]...

Jobs of nine phases that do nothing, as many as an attack of 30 steps has, run on an executor: ``local``, ``ray-local``
or ``ray://HOST:PORT``. Then the process of a running phase is killed, and on Ray its task: seconds until the phase
begins again, on another worker if there are several.
"""

import argparse
import os
import signal
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from tests.service.processes import listening
from tests.service.ray_nodes import task_of

import trompe_server.job.texture_attack  # noqa: F401  what an attack imports
from bench.job_list import size
from trompe_server.executor.dispatcher import Dispatcher
from trompe_server.job.protocol import OnProgress, PhaseReport
from trompe_server.queue.claims import Claims
from trompe_server.queue.store import JobStore
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.service.dispatch import open_executor
from trompe_server.settings import Settings
from trompe_server.storage.folders import JobArtifacts, LocalArtifacts
from trompe_shared.api import JobRequest, JobSpec, Progress

PHASES = [f"phase-{number}" for number in range(9)]
LOSSES = 8
"""Processes of a kind killed, two in each job: the third loss in one phase would fail it."""
NAME = "bench"


class Idle:
    """Phases that do nothing. With the label ``wait`` the last one notes its time and process, and waits."""

    def __init__(self, waits: bool, artifacts: JobArtifacts) -> None:
        assert isinstance(artifacts.folder, LocalArtifacts)
        self._notes = artifacts.folder.folder / "notes.txt" if waits else None

    def phases(self) -> list[str]:
        """As many as an attack of 30 steps has."""
        return PHASES

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """Nothing at all, or wait until cancelled."""
        progress = Progress(phase=phase, fraction=(PHASES.index(phase) + 1) / len(PHASES))
        if self._notes is not None and phase == PHASES[-1]:
            with self._notes.open("a") as file:
                file.write(f"{time.time()} {os.getpid()}\n")
            while True:
                on_progress(progress)
                time.sleep(0.02)
        return PhaseReport(progress)


def open_job(spec: JobSpec, *, artifacts: JobArtifacts, **_: Any) -> Idle:
    """Open a job with the signature of ``trompe_server.job.texture_attack.open_job``."""
    return Idle(spec.goal.label == ["wait"], artifacts)


def bench(settings: Settings, count: int) -> None:
    """Print what jobs cost in the empty database of ``settings``."""
    store = JobStore(settings.database_url)
    store.migrate()
    before, began = size(store), time.perf_counter()
    jobs = [submit(store, "mug") for _ in range(count)]
    submitted = time.perf_counter() - began
    with listening() as port:
        renderers = RendererAddresses((("127.0.0.1", port),))
        executor = partial(open_executor, settings, renderers, mark=NAME)
        dispatcher = Dispatcher(Claims(store.engine), executor, name=NAME, silence=30, stall_timeout=600)
        began = time.perf_counter()
        with dispatcher.running():
            wait_for(lambda: store.get(jobs[0]).state.final)
            print(f"{settings.executor}: first job ended after {time.perf_counter() - began:.1f} s")
            wait_for(lambda: store.get(jobs[-1]).state.final)
            ends = sorted(finished.timestamp() for job in jobs if (finished := store.get(job).finished))
            grown = (size(store) - before) / count
            kinds = ["process"] if settings.executor == "local" else ["process", "task"]
            losses = {kind: losses_of(store, Path(settings.store_url), kind) for kind in kinds}
    overhead = settings.workers * statistics.median(after - before for before, after in pairwise(ends))
    print(
        f"{store.engine.dialect.name:12}{1000 * submitted / count:8.1f} ms to submit"
        f"{1000 * overhead:8.1f} ms to run (median of {count}){grown:8.0f} bytes a job"
    )
    for kind, seconds in losses.items():
        print(
            f"{kind} killed, phase begun again: median {statistics.median(seconds):.2f} s, {max(seconds):.2f} s at most"
        )
    store.close()


def submit(store: JobStore, label: str) -> str:
    """Queue a job."""
    return store.create(JobRequest.of("mug", label=label, labels={"run": "1"}))[0].id


def losses_of(store: JobStore, files: Path, kind: str) -> list[float]:
    """Kill a process of this kind of several jobs twice: seconds until their phases begin again."""
    seconds = []
    for _ in range(LOSSES // 2):
        job = submit(store, "wait")
        notes = files / "jobs" / job / "notes.txt"
        for number in (1, 2):
            wait_for(lambda: notes.exists() and len(notes.read_text().splitlines()) == number)  # noqa: B023
            process = task_of(job) if kind == "task" else int(notes.read_text().split()[-1])
            killed = time.time()
            os.kill(process, signal.SIGKILL)
            wait_for(lambda: len(notes.read_text().splitlines()) > number)  # noqa: B023
            seconds.append(float(notes.read_text().split()[-2]) - killed)
        store.request_cancel(job)
        wait_for(lambda: store.get(job).state.final)  # noqa: B023
    return seconds


def wait_for(condition: Callable[[], bool]) -> None:
    """Poll ``condition``."""
    while not condition():
        time.sleep(0.01)


def main() -> None:
    """Measure each database that is named; SQLite in a temporary folder where none is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--executor", default="local", help="local, ray-local or ray://HOST:PORT")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--database", action="append", help="an empty database; repeatable")
    options = parser.parse_args()
    for url in options.database or [""]:
        with tempfile.TemporaryDirectory() as folder:
            pipeline = "bench.job_engine:open_job"
            named = {"executor": options.executor, "workers": options.workers, "database": url, "pipeline": pipeline}
            bench(Settings(data=Path(folder), **named), options.jobs)


if __name__ == "__main__":
    main()
