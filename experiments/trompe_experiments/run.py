"""Runner of an experiment: submits missing jobs, follows them, keeps their results.

In the folder of an experiment, ``jobs/KEY/`` holds one job (``job.json``, ``result.json``, artifacts); ``results.csv``
and ``predictions.csv`` are rewritten from all jobs whenever one ends. If only the tables were kept, their rows stay and
their jobs are not run again.
"""

import time
from collections.abc import Collection, Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Final, Protocol

from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict

from trompe_client._errors import BadRequest, Conflict, NotFound
from trompe_client._plan import Upload
from trompe_experiments.plan import Plan, Row, name_of
from trompe_experiments.service import Service
from trompe_experiments.table import (
    PREDICTIONS,
    REFUSED,
    RESULTS,
    TO_RETRY,
    PredictionRow,
    ResultRow,
    prediction_rows,
    read_table,
    write_table,
)
from trompe_shared.api import Job, JobState, Result
from trompe_shared.comparison import grouped
from trompe_shared.errors import SpecError

PAUSE: Final = 1.0
"""Seconds between two polls of the jobs."""
LOCK: Final = ".lock"
"""Lock file of the run in a folder."""
POLLED: Final = 12
"""Queued jobs polled each time, in turn, besides all running ones: workers may take them in any order."""
Files = Mapping[str, bytes]
Rows = tuple[ResultRow, ...]


class Finished(BaseModel):
    """A finished job. ``error`` says why ``result`` is ``None``. ``row``: its row, if only the table was kept."""

    model_config = ConfigDict(frozen=True)

    state: str
    job: str
    error: str = ""
    result: Result | None = None
    predictions: tuple[PredictionRow, ...] = ()
    row: ResultRow | None = None

    @property
    def failed(self) -> bool:
        """Whether an expected result is missing."""
        return self.state in TO_RETRY


class Show(Protocol):
    """Display of the progress."""

    def begin(self, *, total: int, done: int) -> None:
        """Start with ``total`` jobs, ``done`` of them finished before this run."""

    def look(self, row: Row, job: Job) -> None:
        """Show the current state of a job."""

    def end(self, row: Row, finished: Finished) -> None:
        """Show a finished job."""


def run_experiment(plan: Plan, service: Service, folder: Path, *, show: Show, retry_failed: bool = False) -> Rows:
    """Run the jobs of ``plan`` without a result in ``folder``, and write the tables; returns all rows of the results.

    Failed jobs are submitted again only with ``retry_failed``. A stopped run continues at the next call. A job that the
    server refuses becomes a row; raises ``ClientError`` for any other fault, and ``SpecError`` while another run uses
    ``folder``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / LOCK, blocking=False):
            return _run(plan, service, folder, show, retry_failed=retry_failed)
    except Timeout as error:
        raise SpecError(f"Another run uses {str(folder)!r}: wait for its end, or choose another --out.") from error


def _run(plan: Plan, service: Service, folder: Path, show: Show, *, retry_failed: bool) -> Rows:
    jobs, collected = plan.jobs(), folder / "jobs"
    tables = _from_tables(plan.experiment.name, jobs, folder)
    known = {key: found for key in jobs if (found := _kept(collected / key) or tables.get(key)) is not None}
    missing = [row for key, row in jobs.items() if key not in known or (retry_failed and known[key].failed)]
    show.begin(total=len(jobs), done=len(jobs) - len(missing))
    rows = write_tables(plan, known, folder)
    for row, finished, files in _follow(missing, known, service, plan, show):
        known[row.key] = finished
        _keep(collected / row.key, finished, files)
        rows = write_tables(plan, known, folder)
        show.end(row, finished)
    return rows


def _follow(
    missing: list[Row], known: Mapping[str, Finished], service: Service, plan: Plan, show: Show
) -> Iterator[tuple[Row, Finished, Files]]:
    """Submit and poll; yields each row as it ends, with the files to keep."""
    ids: dict[Upload, str] = {}
    waiting: dict[str, tuple[Row, Job]] = {}
    for row in missing:
        try:
            for upload in row.attack.uploads():
                if upload not in ids:
                    ids[upload] = service.store(upload)
            job = service.submit(row.attack.request(ids), _submission_key(row, known.get(row.key)))
        except (BadRequest, NotFound, Conflict) as error:
            yield row, Finished(state=REFUSED, job="", error=str(error)), {}
            continue
        if job.state.final:
            yield row, *_fetch(row, job, service, plan.experiment.kept)
        else:
            waiting[row.key] = row, job
    while waiting:
        for key in _next(waiting):
            row, before = waiting.pop(key)
            job = service.job(before.id)
            show.look(row, job)
            if job.state.final:
                yield row, *_fetch(row, job, service, plan.experiment.kept)
            else:
                waiting[key] = row, job  # behind the jobs not polled yet
        if waiting:
            time.sleep(PAUSE)


def _next(waiting: Mapping[str, tuple[Row, Job]]) -> list[str]:
    """Keys of the jobs to poll: all running ones and the first queued ones."""
    running = [key for key, (_, job) in waiting.items() if job.state is JobState.running]
    return running + [key for key in waiting if key not in running][:POLLED]


def _submission_key(row: Row, before: Finished | None) -> str:
    """Idempotency key; another one after each failed job."""
    return row.key if before is None or not before.job else f"{row.key}-after-{before.job[:16]}"


def _fetch(row: Row, job: Job, service: Service, artifacts: list[str]) -> tuple[Finished, Files]:
    if job.state not in {JobState.succeeded, JobState.not_applicable}:
        said = job.error or f"the job was {job.state.value}"
        return Finished(state=job.state.value, job=job.id, error=said), {}
    result = service.result(job.id)
    kept = [name for name in job.artifacts if any(fnmatch(name, pattern) for pattern in artifacts)]
    files = {name: data for name in kept if (data := service.artifact(job.id, name)) is not None}
    predictions = tuple(prediction_rows(row.key, result, service.classes(result.spec.victim.classifier)))
    state, note = job.state.value, job.note or ""
    return Finished(state=state, job=job.id, error=note, result=result, predictions=predictions), files


def _kept(folder: Path) -> Finished | None:
    """The job in its own ``folder``, if there is one."""
    try:
        kept = Finished.model_validate_json((folder / "job.json").read_bytes())
        if kept.failed:
            return kept
        result = Result.model_validate_json((folder / "result.json").read_bytes())
    except (FileNotFoundError, ValueError):  # missing, or of another version: the job is submitted again
        return None
    return kept.model_copy(update={"result": result})


def _keep(folder: Path, finished: Finished, files: Files) -> None:
    """Write a job into its own folder, ``job.json`` last: a folder without it does not count."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / Path(name).name).write_bytes(data)
    if finished.result is not None:
        (folder / "result.json").write_text(finished.result.model_dump_json(), "utf-8")
    partial = folder / ".job.json.part"
    partial.write_text(finished.model_dump_json(exclude={"result", "row"}), "utf-8")
    partial.replace(folder / "job.json")


def _from_tables(name: str, wanted: Collection[str], folder: Path) -> dict[str, Finished]:
    """Jobs of an earlier run of the experiment ``name`` without a folder, from the tables in ``folder``, if any.

    Raises ``SpecError`` for unreadable tables, for those of another experiment, and for rows that the new ones would
    lose: of jobs not ``wanted``.
    """
    table = {row.key: row for row in read_table(folder / RESULTS, ResultRow, optional=True)}
    others = {row.experiment for row in table.values()} - {name}
    if others:
        raise SpecError(f"{str(folder)!r} has the results of {min(others)!r}: choose another --out for {name!r}.")
    rows = {key: row for key, row in table.items() if not (folder / "jobs" / key).exists()}
    lost = [row for key, row in rows.items() if key not in wanted]
    if lost:
        raise SpecError(
            f"{str(folder / RESULTS)!r} has rows of {len(lost)} jobs that are not in this experiment, "
            f"such as {lost[0].object}, {lost[0].configuration}, and would lose them: choose another --out, or "
            "move the table."
        )
    predictions = read_table(folder / PREDICTIONS, PredictionRow, optional=True) if rows else []
    own = grouped(predictions, lambda each: each.key)
    return {
        key: Finished(state=row.state, job=row.job, error=row.error, predictions=tuple(own.get(key, ())), row=row)
        for key, row in rows.items()
    }


def write_tables(plan: Plan, known: Mapping[str, Finished], folder: Path) -> Rows:
    """Write both tables; returns the rows of the results."""
    rows = tuple(_result_row(row, known[row.key]) for row in plan.rows if row.key in known)
    write_table(folder / RESULTS, rows)
    predictions = [each for key in plan.jobs() if key in known for each in known[key].predictions]
    write_table(folder / PREDICTIONS, predictions, PredictionRow)
    return rows


def _result_row(row: Row, finished: Finished) -> ResultRow:
    name = {"object": row.object}
    if finished.row is not None:
        kept: ResultRow = finished.row.model_copy(update=row.place.model_dump() | name)
        return kept
    ended = name | {"state": finished.state, "job": finished.job}
    if finished.result is not None:
        return ResultRow.of_result(row.place, finished.result, **ended)
    classifier = name_of(row.request.victim.classifier)
    return ResultRow.of_spec(row.place, row.request.spec(), error=finished.error, classifier=classifier, **ended)
