"""How fast the list of jobs is with 100,000 of them: python -m bench.job_list [--jobs N] [--database URL]...

For each database: the time of a first page of 50 jobs, unfiltered and by state, label, object and both, of a page deep
in the list, of the counts and the statistics, and of claiming a job. The quickest, median and 99th percentile of 50
calls, milliseconds: the first is what the machine can do, the others what else it did meanwhile.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import sqlalchemy as sa

from trompe_server.queue.claims import Claims, Ending
from trompe_server.queue.store import JobStore
from trompe_server.queue.tables import jobs, labels
from trompe_server.storage.database import write
from trompe_shared.api import JobRequest, JobSpec, JobState, Needs

BATCH = 1000
CALLS = 50
STATES = [JobState.succeeded] * 96 + [JobState.failed, JobState.cancelled, JobState.not_applicable, JobState.queued]
LEAST = len(STATES) * (CALLS + 1)


def fill(store: JobStore, count: int) -> None:
    """Make ``count`` jobs: 96 % have succeeded, 1 % each have failed, were cancelled, are n.a., are queued."""
    spec = JobSpec.of("mug", label="mug").model_dump(mode="json")
    for first in range(0, count, BATCH):
        rows, pairs = [], []
        for number in range(first + 1, min(first + BATCH, count) + 1):
            mine = {"run": f"run-{number // 500}", "seed": str(number % 10)}
            state = STATES[number % len(STATES)].value
            rows.append(
                {
                    "number": number,
                    "id": f"{number:016x}",
                    "state": state,
                    "spec": spec,
                    "object": f"object-{number % 50}",
                    "classifier": f"net-{number % 5}",
                    "priority": 100,
                    "needs": "{}",
                    "labels": mine,
                    "created": float(number),
                    "finished": float(number) if state != JobState.queued else None,
                    "attempts": 1,
                    "events": 0,
                    "artifacts": ["result.json"],
                }
            )
            pairs += [{"key": key, "value": value, "number": number} for key, value in mine.items()]
        with write(store.engine) as connection:
            connection.execute(jobs.insert(), rows)
            connection.execute(labels.insert(), pairs)
    with store.engine.connect() as connection:
        connection.exec_driver_sql("ANALYZE")
        if store.engine.dialect.name == "postgresql":
            connection.exec_driver_sql("SELECT setval('jobs_number_seq', (SELECT max(number) FROM jobs))")
        connection.commit()


def measured(call: Callable[[], object]) -> tuple[float, float, float]:
    """The quickest, the median and the 99th percentile of a call, milliseconds."""
    call()
    times = []
    for _ in range(CALLS):
        began = time.perf_counter()
        call()
        times.append(1000 * (time.perf_counter() - began))
    return min(times), statistics.median(times), statistics.quantiles(times, n=100)[98]


def cases(store: JobStore, count: int) -> Iterator[tuple[str, Callable[[], object]]]:
    """What is measured, in the order of the table."""
    last = f"run-{(count - 1) // 500}"
    yield "first page", store.page
    yield "page in the middle", lambda: store.page(cursor=str(count // 2))
    yield "state failed", lambda: store.page(state=JobState.failed)
    yield "state running (none)", lambda: store.page(state=JobState.running)
    yield "label run, newest", lambda: store.page(labels={"run": last})
    yield "label run, oldest", lambda: store.page(labels={"run": "run-0"})
    yield "label seed (a tenth)", lambda: store.page(labels={"seed": "3"})
    yield "two labels", lambda: store.page(labels={"seed": "3", "run": "run-0"})
    yield "label and state", lambda: store.page(labels={"seed": "3"}, state=JobState.failed)
    yield "object", lambda: store.page(object="object-7")
    yield "counts", store.counts
    yield "oldest queued", store.oldest_queued
    claims = Claims(store.engine)
    yield "claim and finish", lambda: take(claims)
    yield "submit", lambda: store.create(JobRequest.of("mug", label="mug"))


def take(claims: Claims) -> None:
    """Take a job and end it."""
    claim = claims.claim(Needs(), "bench")
    assert claim is not None
    claims.finish(claim, Ending(JobState.succeeded))


def size(store: JobStore) -> int:
    """Bytes of the whole database."""
    postgres = "SELECT pg_database_size(current_database())"
    sqlite = "SELECT page_count * page_size FROM pragma_page_count(), pragma_page_size()"
    with store.engine.connect() as connection:
        query = postgres if store.engine.dialect.name == "postgresql" else sqlite
        return int(connection.execute(sa.text(query)).scalar_one())


def bench(url: str, count: int) -> None:
    """Fill the database at ``url`` and print its table."""
    store = JobStore(url)
    store.migrate()
    empty = size(store)
    fill(store, count)
    print(f"\n{store.engine.dialect.name}, {count} jobs, {(size(store) - empty) / count:.0f} bytes a job")
    print(f"{'':24}{'best':>8}{'median':>8}{'p99':>8}  ms")
    for name, call in cases(store, count):
        print(f"{name:24}" + "".join(f"{each:8.1f}" for each in measured(call)))
    store.close()


def main() -> None:
    """Measure each database that is named; SQLite in a temporary folder where none is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--database", action="append", help="an empty database; repeatable")
    options = parser.parse_args()
    if options.jobs < LEAST:
        parser.error(f"--jobs must be at least {LEAST}: one in {len(STATES)} is queued, and {CALLS + 1} are claimed.")
    with tempfile.TemporaryDirectory() as folder:
        for url in options.database or [f"sqlite:///{Path(folder, 'trompe.sqlite')}"]:
            bench(url, options.jobs)


if __name__ == "__main__":
    main()
