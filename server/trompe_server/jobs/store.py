"""Our own record of jobs and of what happened to them: quick to list, whatever engine runs the jobs.

It lives in the same SQLite file as the engine's tables, so that a job and its place in the queue are made in one
transaction.
"""

import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa

from trompe_server.errors import NotFoundError
from trompe_shared.api import Event, Job, JobList, JobSpec, JobState, Progress
from trompe_shared.errors import SpecError

__all__ = ["MAX_LOST", "JobStore"]

MAX_LOST: Final = 3
"""A job that ended this many workers is failed."""

_metadata = sa.MetaData()
_jobs = sa.Table(
    "jobs",
    _metadata,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("id", sa.String, unique=True, nullable=False),
    sa.Column("state", sa.String, nullable=False, index=True),
    sa.Column("spec", sa.JSON, nullable=False),
    sa.Column("created", sa.Float, nullable=False),
    sa.Column("started", sa.Float),
    sa.Column("finished", sa.Float),
    sa.Column("progress", sa.JSON, nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False, default=0),
    sa.Column("lost", sa.Integer, nullable=False, default=0),
    sa.Column("cancel_requested", sa.Boolean, nullable=False, default=False),
    sa.Column("error", sa.String),
    sa.Column("note", sa.String),
    sa.Column("artifacts", sa.JSON, nullable=False, default=list),
    sqlite_autoincrement=True,
)
_events = sa.Table(
    "job_events",
    _metadata,
    sa.Column("job", sa.String, primary_key=True),
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("time", sa.Float, nullable=False),
    sa.Column("state", sa.String, nullable=False),
    sa.Column("progress", sa.JSON, nullable=False),
    sa.Column("message", sa.String),
)


class JobStore:
    """Jobs and their events in the SQLite file ``database``. Safe to use from many threads and processes."""

    def __init__(self, database: Path) -> None:
        self._engine = sa.create_engine(f"sqlite:///{database}")
        sa.event.listen(self._engine, "connect", _prepare_connection)

    def migrate(self) -> None:
        """Make the tables where they are missing, and put the file in WAL mode, which lasts."""
        with self._engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA journal_mode=WAL")
        with self._write() as connection:
            _metadata.create_all(connection)

    def close(self) -> None:
        """Let go of the file."""
        self._engine.dispose()

    def create(self, spec: JobSpec, enqueue: Callable[[sa.Connection, str], None]) -> Job:
        """A new queued job. ``enqueue`` puts its id in the engine's queue within the same transaction."""
        job = secrets.token_hex(8)
        with self._write() as connection:
            row = {"id": job, "state": JobState.queued, "spec": spec.model_dump(mode="json"), "created": time.time()}
            connection.execute(_jobs.insert().values(row | {"progress": Progress().model_dump(mode="json")}))
            self._log(connection, job, "queued")
            enqueue(connection, job)
            return self._get(connection, job)

    def get(self, job: str) -> Job:
        """The job with this id. Raises ``NotFoundError``."""
        with self._engine.connect() as connection:
            return self._get(connection, job)

    def page(self, *, state: JobState | None = None, limit: int = 50, cursor: str | None = None) -> JobList:
        """One page of jobs, newest first. Raises ``SpecError`` for a cursor that is none of ours."""
        query = sa.select(_jobs).order_by(_jobs.c.number.desc()).limit(limit + 1)
        if state is not None:
            query = query.where(_jobs.c.state == state)
        if cursor is not None:
            if not cursor.isdecimal():
                raise SpecError(f"{cursor!r} is not a cursor; pass next_cursor of the page before.")
            query = query.where(_jobs.c.number < int(cursor))
        with self._engine.connect() as connection:
            rows = connection.execute(query).all()
        page = rows[:limit]
        return JobList(
            jobs=[_job(row) for row in page], next_cursor=str(page[-1].number) if len(rows) > limit else None
        )

    def events(self, job: str, *, after: int = 0) -> list[Event]:
        """Events of a job with ids above ``after``, oldest first."""
        query = sa.select(_events).where(_events.c.job == job, _events.c.id > after).order_by(_events.c.id)
        with self._engine.connect() as connection:
            return [_event(row) for row in connection.execute(query)]

    def request_cancel(self, job: str) -> Job:
        """Cancel a queued job at once, and ask the worker of a running one to stop. Raises ``NotFoundError``."""
        with self._write() as connection:
            state = self._get(connection, job).state
            if state is JobState.queued:
                self._finish(connection, job, JobState.cancelled, message="cancelled before it started")
            elif state is JobState.running:
                self._update(connection, job, cancel_requested=True)
                self._log(connection, job, "cancel requested")
            return self._get(connection, job)

    def begin(self, job: str) -> Job | None:
        """Note that a worker takes the job up; None when there is nothing to do any more.

        A job that is found running was lost by a worker that died; the third time it is failed.
        """
        with self._write() as connection:
            row = self._row(connection, job)
            if JobState(row.state).final:
                return None
            lost = row.lost + (row.state == JobState.running)
            if row.cancel_requested:
                self._finish(connection, job, JobState.cancelled, message="cancelled")
                return None
            if lost >= MAX_LOST:
                self._finish(connection, job, JobState.failed, error=_killed_workers(lost), lost=lost)
                return None
            started = row.started or time.time()
            self._update(connection, job, state=JobState.running, attempts=row.attempts + 1, lost=lost, started=started)
            self._log(connection, job, "started" if row.attempts == 0 else "goes on after an interruption")
            return self._get(connection, job)

    def give_back(self, job: str) -> None:
        """A worker that stops in good order leaves the job to the next one; this does not count against the job."""
        with self._write() as connection:
            if self._row(connection, job).state == JobState.running:
                self._update(connection, job, state=JobState.queued)
                self._log(connection, job, "the worker stopped; the job goes on with the next one")

    def advance(self, job: str, progress: Progress, *, public: tuple[str, ...] = ()) -> bool:
        """Note progress, and artifacts that are for the user. Returns whether the job shall be cancelled."""
        with self._write() as connection:
            row = self._row(connection, job)
            artifacts = list(dict.fromkeys([*row.artifacts, *public]))
            self._update(connection, job, progress=progress.model_dump(mode="json"), artifacts=artifacts)
            self._log(connection, job)
            return bool(row.cancel_requested)

    def cancel_requested(self, job: str) -> bool:
        """Whether the job shall be cancelled."""
        with self._engine.connect() as connection:
            return bool(self._row(connection, job).cancel_requested)

    def finish(self, job: str, state: JobState, *, error: str | None = None, note: str | None = None) -> None:
        """End the job; a job that has ended already stays as it is."""
        with self._write() as connection:
            if not JobState(self._row(connection, job).state).final:
                self._finish(connection, job, state, message=error or note, error=error, note=note)

    @contextmanager
    def _write(self) -> Iterator[sa.Connection]:
        """A transaction that holds the write lock from its beginning, so that what it read stays true."""
        with self._engine.begin() as connection:
            connection.exec_driver_sql("BEGIN IMMEDIATE")
            yield connection

    def _row(self, connection: sa.Connection, job: str) -> "sa.Row[Any]":
        row = connection.execute(sa.select(_jobs).where(_jobs.c.id == job)).one_or_none()
        if row is None:
            raise NotFoundError(f"There is no job {job!r}. GET /v1/jobs lists them.")
        return row

    def _get(self, connection: sa.Connection, job: str) -> Job:
        return _job(self._row(connection, job))

    def _update(self, connection: sa.Connection, job: str, **values: Any) -> None:
        connection.execute(_jobs.update().where(_jobs.c.id == job).values(**values))

    def _finish(
        self, connection: sa.Connection, job: str, state: JobState, *, message: str | None = None, **values: Any
    ) -> None:
        self._update(connection, job, state=state, finished=time.time(), **values)
        self._log(connection, job, message or values.get("error"))

    def _log(self, connection: sa.Connection, job: str, message: str | None = None) -> None:
        """Append an event that shows the job as it is now."""
        row = self._row(connection, job)
        last = sa.select(sa.func.coalesce(sa.func.max(_events.c.id), 0)).where(_events.c.job == job)
        number = connection.execute(last).scalar_one() + 1
        values = {"job": job, "id": number, "time": time.time(), "state": row.state, "progress": row.progress}
        connection.execute(_events.insert().values(values | {"message": message}))


def _prepare_connection(connection: Any, _record: Any) -> None:
    connection.isolation_level = "IMMEDIATE"
    connection.execute("PRAGMA busy_timeout=30000")
    connection.execute("PRAGMA synchronous=NORMAL")


def _killed_workers(lost: int) -> str:
    return f"{lost} workers died while they ran this job, so it is not tried again; the log of the service says how."


def _time(seconds: float | None) -> datetime | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def _job(row: "sa.Row[Any]") -> Job:
    times = {name: _time(getattr(row, name)) for name in ("created", "started", "finished")}
    same = {
        name: getattr(row, name)
        for name in ("id", "state", "spec", "progress", "attempts", "error", "note", "artifacts")
    }
    return Job.model_validate(same | times)


def _event(row: "sa.Row[Any]") -> Event:
    return Event.model_validate(
        {"id": row.id, "time": _time(row.time), "state": row.state, "progress": row.progress, "message": row.message}
    )
