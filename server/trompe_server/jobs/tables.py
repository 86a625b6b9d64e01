"""The tables of jobs and workers, and what their rows mean. The queue is the jobs themselves: those that are queued."""

from datetime import UTC, datetime
from typing import Any, Final

import sqlalchemy as sa
from pydantic import ValidationError

from trompe_server.database import clock
from trompe_server.errors import NotFoundError
from trompe_shared.api import Event, Job, JobSpec

__all__ = [
    "LEASES",
    "PRIORITIES",
    "TOTALS",
    "append_event",
    "event_of",
    "events",
    "fresh",
    "job_of",
    "jobs",
    "labels",
    "leases",
]
__all__ += ["locked", "metadata", "spec_of", "time_of", "totals", "update_job", "workers"]

PRIORITIES: Final = {"interactive": 10, "normal": 100, "sweep": 1000}
"""Lower numbers go first; they stand here in that order."""

Row = sa.Row[Any]

_number = sa.BigInteger().with_variant(sa.Integer, "sqlite")

metadata = sa.MetaData()
jobs = sa.Table(
    "jobs",
    metadata,
    sa.Column("number", _number, primary_key=True, autoincrement=True),
    sa.Column("id", sa.String, unique=True, nullable=False),
    sa.Column("state", sa.String, nullable=False),
    sa.Column("spec", sa.JSON, nullable=False),
    sa.Column("object", sa.String, nullable=False),
    sa.Column("classifier", sa.String, nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    sa.Column("needs", sa.String, nullable=False),
    sa.Column("labels", sa.JSON, nullable=False),
    sa.Column("idempotency_key", sa.String, unique=True),
    sa.Column("worker", sa.String),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("started", sa.Double),
    sa.Column("finished", sa.Double),
    sa.Column("progress", sa.JSON, nullable=False),
    sa.Column("done", sa.Integer, nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("lost", sa.Integer, nullable=False),
    sa.Column("events", sa.Integer, nullable=False),
    sa.Column("cancel_requested", sa.Boolean, nullable=False),
    sa.Column("error", sa.String),
    sa.Column("note", sa.String),
    sa.Column("artifacts", sa.JSON, nullable=False),
    sqlite_autoincrement=True,
)
"""``attempts`` says how often a worker took the job up, and is what a worker must name to write; ``lost`` is how often
one died with it since it last finished a phase; ``done`` counts the phases that need not be run again; ``events`` the
rows of ``job_events``.
"""
sa.Index("jobs_by_state", jobs.c.state, jobs.c.number)
sa.Index("jobs_by_object", jobs.c.object, jobs.c.number)
sa.Index("jobs_by_classifier", jobs.c.classifier, jobs.c.number)
sa.Index("jobs_to_take", jobs.c.state, jobs.c.needs, jobs.c.priority, jobs.c.number)
sa.Index("jobs_by_end", jobs.c.finished)

labels = sa.Table(
    "job_labels",
    metadata,
    sa.Column("key", sa.String, primary_key=True),
    sa.Column("value", sa.String, primary_key=True),
    sa.Column("number", _number, sa.ForeignKey(jobs.c.number, ondelete="CASCADE"), primary_key=True, index=True),
)
"""What jobs are found by."""

events = sa.Table(
    "job_events",
    metadata,
    sa.Column("job", sa.String, primary_key=True),
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("state", sa.String, nullable=False),
    sa.Column("progress", sa.JSON, nullable=False),
    sa.Column("message", sa.String),
)

workers = sa.Table(
    "workers",
    metadata,
    sa.Column("id", sa.String, primary_key=True),
    sa.Column("host", sa.String, nullable=False),
    sa.Column("device", sa.String, nullable=False),
    sa.Column("started", sa.Double, nullable=False),
    sa.Column("seen", sa.Double, nullable=False),
    sa.Column("job", sa.String),
)

totals = sa.Table(
    "totals", metadata, sa.Column("name", sa.String, primary_key=True), sa.Column("value", sa.Double, nullable=False)
)
"""What all workers together have done so far."""
TOTALS: Final = (
    "attack_steps",
    "step_seconds",
    "classifier_images",
    "classifier_seconds",
    "target_renders",
    "target_seconds",
)

leases = sa.Table(
    "leases",
    metadata,
    sa.Column("name", sa.String, primary_key=True),
    sa.Column("until", sa.Double, nullable=False),
)
"""Work that one process at a time does, and until when it is taken."""
LEASES: Final = ("retention",)


def fresh(connection: sa.Connection, job: str) -> Row:
    """The row of a job. Raises ``NotFoundError``."""
    return _one(connection, sa.select(jobs).where(jobs.c.id == job), job)


def locked(connection: sa.Connection, job: str) -> Row:
    """The row of a job, which nobody else changes until the transaction ends. Raises ``NotFoundError``."""
    return _one(connection, sa.select(jobs).where(jobs.c.id == job).with_for_update(), job)


def _one(connection: sa.Connection, query: sa.Select[Any], job: str) -> Row:
    row = connection.execute(query).one_or_none()
    if row is None:
        raise NotFoundError(f"There is no job {job!r}. GET /v1/jobs lists them.")
    return row


def update_job(connection: sa.Connection, job: str, *, message: str | None = None, **values: Any) -> Row:
    """Change a job and append the event that shows it as it is then; its row."""
    change = jobs.update().where(jobs.c.id == job).values(events=jobs.c.events + 1, **values).returning(jobs)
    row = connection.execute(change).one()
    append_event(connection, row, message)
    return row


def append_event(connection: sa.Connection, row: Row, message: str | None) -> None:
    """The event numbered ``row.events``, which shows the job as it is now."""
    values = {"job": row.id, "id": row.events, "state": row.state, "progress": row.progress, "message": message}
    connection.execute(events.insert().values(time=clock(), **values))


def time_of(seconds: float | None) -> datetime | None:
    """A point in time of the database's clock."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


_SAME: Final = (
    "id",
    "state",
    "labels",
    "needs",
    "worker",
    "progress",
    "attempts",
    "error",
    "artifacts",
)


def job_of(row: Row) -> Job:
    """A row of ``jobs`` as the API shows it. What of it only another version of Trompe understands, its note says."""
    times = {name: time_of(getattr(row, name)) for name in ("created", "started", "finished")}
    same = {name: getattr(row, name) for name in _SAME}
    spec, foreign = spec_of(row)
    left_out = f"Not understood by this version of Trompe and not shown: the options {foreign}." if foreign else None
    note = " ".join(filter(None, [row.note, left_out])) or None
    return Job.model_validate(same | times | {"spec": spec, "note": note, "priority": _priority(row.priority)})


_ALWAYS: Final = {"object", "label"}


def spec_of(row: Row) -> tuple[JobSpec, list[str]]:
    """What a job asks for, and the options that are left out because only another version of Trompe knows them, or
    knows what they are set to."""
    given: dict[str, Any] = dict(row.spec)
    while True:
        try:
            return JobSpec.model_validate(given), sorted(row.spec.keys() - given.keys())
        except ValidationError as error:
            odd = {str(each["loc"][0]) for each in error.errors() if each["loc"]}
            left_out = (odd & given.keys() or given.keys()) - _ALWAYS
            if not left_out:
                raise
            given = {name: value for name, value in given.items() if name not in left_out}


def _priority(number: int) -> str:
    """The name of a priority. A number that another version or a person wrote is called by what comes no sooner."""
    return next((name for name, last in PRIORITIES.items() if number <= last), "sweep")


def event_of(row: Row) -> Event:
    """A row of ``job_events`` as the API shows it."""
    return Event.model_validate(
        {"id": row.id, "time": time_of(row.time), "state": row.state, "progress": row.progress, "message": row.message}
    )
