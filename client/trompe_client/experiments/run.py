"""Running an experiment: submit what is missing, follow it, keep what comes out.

In the folder of an experiment, ``jobs/KEY/`` holds what came of one job (``job.json``, ``result.json``, artifacts);
``results.csv`` and ``predictions.csv`` are made from all of them, anew with every job that ends. Where only the tables
were kept, what they say of a job stays, and it is not run again.
"""

import time
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from filelock import FileLock, Timeout
from pydantic import BaseModel

from trompe_client._errors import APIError
from trompe_client.experiments.plan import Plan, Row
from trompe_client.experiments.service import Service
from trompe_shared.api import Job, JobState, Result
from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import (
    PREDICTIONS,
    RESULTS,
    PredictionRow,
    ResultRow,
    prediction_rows,
    read_table,
    write_table,
)

__all__ = ["Finished", "Outcome", "Show", "run_experiment"]

PAUSE: Final = 1.0
"""Seconds between two looks at the jobs."""
LOCK: Final = ".lock"
"""Held by the run that is at work in a folder."""
LOOK_AT: Final = 12
"""Waiting jobs that are looked at each time, beside those that run: the next ones in turn, for workers may take them in
any order."""
REFUSED: Final = "refused"
"""State of a row that the server did not take."""
TO_RETRY: Final = {JobState.failed.value, JobState.cancelled.value, REFUSED}


@dataclass(frozen=True)
class Finished:
    """What came of one job. ``result`` is ``None`` where it came to none; ``error`` says why. ``row``: its row, where
    that is all that was kept."""

    state: str
    job: str
    error: str = ""
    result: Result | None = None
    predictions: tuple[PredictionRow, ...] = ()
    row: ResultRow | None = None

    @property
    def failed(self) -> bool:
        """Whether there is no result though there should be."""
        return self.state in TO_RETRY


@dataclass(frozen=True)
class Outcome:
    """What came of an experiment: all its rows, and those among them that failed."""

    rows: tuple[ResultRow, ...]

    @property
    def failed(self) -> tuple[ResultRow, ...]:
        """Rows without a result though they should have one; n.a. is a result."""
        return tuple(row for row in self.rows if row.state in TO_RETRY)


class Show(Protocol):
    """Where progress is shown."""

    def begin(self, *, total: int, done: int) -> None:
        """``total`` jobs in all, ``done`` of them before this run."""
        ...

    def look(self, row: Row, job: Job) -> None:
        """A job, as it stands."""
        ...

    def end(self, row: Row, finished: Finished) -> None:
        """A job is done."""
        ...


def run_experiment(plan: Plan, service: Service, folder: Path, *, show: Show, retry_failed: bool = False) -> Outcome:
    """Run all jobs of ``plan`` that ``folder`` has no result of yet, and write the tables.

    A job that failed before is left so, or submitted anew with ``retry_failed``. May be stopped at any time and called
    again. Raises ``ServerUnreachable`` when the server goes away, and ``SpecError`` where another run is at work in
    ``folder``: each would overwrite the other's tables.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / LOCK, blocking=False):
            return _run(plan, service, folder, show, retry_failed=retry_failed)
    except Timeout as error:
        raise SpecError(
            f"Another run of an experiment is at work in {str(folder)!r}: wait until it has ended, or choose another "
            "--out."
        ) from error


def _run(plan: Plan, service: Service, folder: Path, show: Show, *, retry_failed: bool) -> Outcome:
    jobs, collected = plan.jobs(), _Collected(folder)
    tables = _Tables.of(jobs, folder)
    known = {key: found for key in jobs if (found := collected.load(key) or tables.told(key)) is not None}
    missing = [row for key, row in jobs.items() if key not in known or (retry_failed and known[key].failed)]
    show.begin(total=len(jobs), done=len(jobs) - len(missing))
    rows = write_tables(plan, known, folder)
    for row, finished in _follow(missing, known, service, plan, show):
        known[row.key] = collected.save(row.key, finished)
        rows = write_tables(plan, known, folder)
        show.end(row, finished.outcome)
    return Outcome(rows)


@dataclass(frozen=True)
class _Fetched:
    """A finished job with the files that are to be kept, by name."""

    outcome: Finished
    job: Job | None
    files: Mapping[str, bytes]


def _follow(
    missing: list[Row], known: Mapping[str, Finished], service: Service, plan: Plan, show: Show
) -> Iterator[tuple[Row, _Fetched]]:
    """Submit and watch; each row as it is done."""
    ids: dict[str, str] = {}
    waiting: dict[str, tuple[Row, Job]] = {}
    for row in missing:
        try:
            for name, file in row.uploads.items():
                if name not in ids:
                    ids[name] = service.store(file)
            job = service.submit(row.stored(ids), _submission_key(row, known.get(row.key)))
        except APIError as error:
            yield row, _Fetched(Finished(REFUSED, "", str(error)), None, {})
            continue
        if job.state.final:
            yield row, _fetch(row, job, service, plan.experiment.artifacts)
        else:
            waiting[row.key] = row, job
    while waiting:
        for key in _next(waiting):
            row, before = waiting.pop(key)
            job = service.job(before.id)
            show.look(row, job)
            if job.state.final:
                yield row, _fetch(row, job, service, plan.experiment.artifacts)
            else:
                waiting[key] = row, job  # behind those that were not looked at
        if waiting:
            time.sleep(PAUSE)


def _next(waiting: Mapping[str, tuple[Row, Job]]) -> list[str]:
    """The jobs whose turn it is to be looked at: those that run, and the first few of the others."""
    running = [key for key, (_, job) in waiting.items() if job.state is JobState.running]
    return running + [key for key in waiting if key not in running][:LOOK_AT]


def _submission_key(row: Row, before: Finished | None) -> str:
    """The idempotency key: another one after each job that failed."""
    return row.key if before is None or not before.job else f"{row.key}-after-{before.job[:16]}"


def _fetch(row: Row, job: Job, service: Service, artifacts: list[str]) -> _Fetched:
    """The result and the files of a job that is done."""
    if job.state not in {JobState.succeeded, JobState.not_applicable}:
        said = job.error or f"the job was {job.state.value}"
        return _Fetched(Finished(job.state.value, job.id, said), job, {})
    result = service.result(job.id)
    files = {name: data for name in artifacts if (data := service.artifact(job.id, name)) is not None}
    predictions = prediction_rows(row.key, result, service.classes(result.spec.classifier))
    return _Fetched(Finished(job.state.value, job.id, job.note or "", result, tuple(predictions)), job, files)


class _Collected:
    """The folder ``jobs``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "jobs"

    def load(self, key: str) -> Finished | None:
        """What came of a job, if it is there."""
        folder = self._folder / key
        try:
            kept = _Kept.model_validate_json((folder / "job.json").read_bytes())
            result = Result.model_validate_json((folder / "result.json").read_bytes()) if kept.has_result else None
        except (FileNotFoundError, ValueError):  # not there, or of another version: the job is asked for again
            return None
        return Finished(kept.state, kept.job, kept.error, result, tuple(kept.predictions))

    def save(self, key: str, fetched: _Fetched) -> Finished:
        """Keep what came of a job; ``job.json`` is last, so that the folder counts when all of it is there."""
        folder, outcome = self._folder / key, fetched.outcome
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in fetched.files.items():
            path = folder / Path(name).name
            path.write_bytes(data)
        if outcome.result is not None:
            (folder / "result.json").write_text(outcome.result.model_dump_json(), "utf-8")
        kept = _Kept(
            state=outcome.state,
            job=outcome.job,
            error=outcome.error,
            has_result=outcome.result is not None,
            predictions=list(outcome.predictions),
        )
        partial = folder / ".job.json.part"
        partial.write_text(kept.model_dump_json(), "utf-8")
        partial.replace(folder / "job.json")
        return outcome


@dataclass(frozen=True)
class _Tables:
    """What the tables of an earlier run say, by job, of jobs of which nothing else was kept."""

    rows: Mapping[str, ResultRow]
    predictions: Mapping[str, Sequence[PredictionRow]]

    @classmethod
    def of(cls, wanted: Collection[str], folder: Path) -> "_Tables":
        """The tables in ``folder``, if there are any. Raises ``SpecError`` where they cannot be read, and for rows of
        other jobs than those ``wanted`` of which there is nothing else: the new tables would lack them."""
        if not (folder / RESULTS).exists():
            return cls({}, {})
        table = {row.key: row for row in read_table(folder / RESULTS, ResultRow)}
        rows = {key: row for key, row in table.items() if not (folder / "jobs" / key).exists()}
        lost = [row for key, row in rows.items() if key not in wanted]
        if lost:
            raise SpecError(
                f"{str(folder / RESULTS)!r} has rows of {len(lost)} jobs that this experiment does not ask for, "
                f"such as {lost[0].object}, {lost[0].configuration}, and nothing else is left of them: choose another "
                "--out, or move the table away."
            )
        predictions = defaultdict(list)
        if (folder / PREDICTIONS).exists():
            for each in read_table(folder / PREDICTIONS, PredictionRow):
                predictions[each.key].append(each)
        return cls(rows, predictions)

    def told(self, key: str) -> Finished | None:
        """What they say of a job."""
        row = self.rows.get(key)
        if row is None:
            return None
        return Finished(row.state, row.job, row.error, predictions=tuple(self.predictions.get(key, ())), row=row)


class _Kept(BaseModel):
    """``job.json``."""

    state: str
    job: str
    error: str
    has_result: bool
    predictions: list[PredictionRow]


def write_tables(plan: Plan, known: Mapping[str, Finished], folder: Path) -> tuple[ResultRow, ...]:
    """Write both tables; gives the rows of the results."""
    rows = tuple(_result_row(row, known[row.key]) for row in plan.rows if row.key in known)
    write_table(folder / RESULTS, rows)
    predictions = [each for key in plan.jobs() if key in known for each in known[key].predictions]
    write_table(folder / PREDICTIONS, predictions, PredictionRow)
    return rows


def _result_row(row: Row, finished: Finished) -> ResultRow:
    if finished.row is not None:
        return finished.row.model_copy(update=row.place.model_dump())
    if finished.result is not None:
        return ResultRow.of_result(row.place, finished.result, state=finished.state, job=finished.job)
    names = {"object": row.object, "classifier": _classifier_name(row)}
    return ResultRow.of_spec(
        row.place, row.request.spec(), state=finished.state, job=finished.job, error=finished.error, **names
    )


def _classifier_name(row: Row) -> str:
    """What people call the classifier: the stem of its file, or its name."""
    file = row.uploads.get(row.request.classifier)
    return Path(file.upload.filename).stem if file is not None else row.request.classifier
