"""What a job costs apart from its attack: python -m bench.job_engine [--jobs N] [--workers N] [--database URL]...

Jobs of nine phases that do nothing (as many as an attack of 30 steps has) are submitted, and run by workers in threads
of this process: seconds of submitting and of running one job, jobs a second, and bytes a job of database.
"""

import argparse
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bench.job_list import size
from trompe_server.executor.runner import JobRunner, OpenedJob
from trompe_server.job.protocol import OnProgress, PhaseReport
from trompe_server.queue.claims import Claims
from trompe_server.queue.store import JobStore
from trompe_shared.api import JobRequest, Progress

PHASES = [f"phase-{number}" for number in range(9)]


class Idle:
    """A pipeline that does nothing."""

    def phases(self) -> list[str]:
        """As many as an attack of 30 steps has."""
        return PHASES

    def run(self, phase: str, on_progress: OnProgress) -> PhaseReport:
        """Nothing at all."""
        return PhaseReport(Progress(phase=phase, fraction=(PHASES.index(phase) + 1) / len(PHASES)))


def work(store: JobStore, name: str) -> int:
    """Run jobs until there are none; how many it were."""
    runner = JobRunner(Claims(store.engine, name), lambda _: OpenedJob(Idle(), lambda: None))
    count = 0
    while (claim := runner.claims.claim(("any",))) is not None:
        runner.run(claim)
        count += 1
    return count


def bench(url: str, count: int, workers: int) -> None:
    """Print what jobs cost in the empty database at ``url``."""
    store = JobStore(url)
    store.migrate()
    before, began = size(store), time.perf_counter()
    for _ in range(count):
        store.create(JobRequest.of("mug", label="mug", labels={"run": "1"}))
    submitted, began = time.perf_counter() - began, time.perf_counter()
    with ThreadPoolExecutor(workers) as pool:
        done = sum(pool.map(lambda number: work(store, f"w{number}"), range(workers)))
    took = time.perf_counter() - began
    assert done == count
    print(
        f"{store.engine.dialect.name:12}{1000 * submitted / count:8.1f} ms to submit"
        f"{1000 * took / count:8.1f} ms to run"
        f"{count / took:8.1f} jobs/s by {workers} workers{(size(store) - before) / count:8.0f} bytes a job"
    )
    store.close()


def main() -> None:
    """Measure each database that is named; SQLite in a temporary folder where none is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=300)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--database", action="append", help="an empty database; repeatable")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for url in options.database or [f"sqlite:///{Path(folder, 'trompe.sqlite')}"]:
            bench(url, options.jobs, options.workers)


if __name__ == "__main__":
    main()
