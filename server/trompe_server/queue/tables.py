"""Tables of jobs and workers, and conversion of their rows. The queue is the set of jobs in state ``queued``."""

import json
from datetime import UTC, datetime
from typing import Any, Final

import sqlalchemy as sa

from trompe_server.errors import NotFoundError
from trompe_server.storage.database import clock
from trompe_shared.api import Event, Job, JobState, Needs, Progress

PRIORITIES: Final = {"interactive": 10, "normal": 100, "sweep": 1000}
"""Lower numbers run first."""

Row = sa.Row[Any]

_number = sa.BigInteger().with_variant(sa.Integer, "sqlite")

metadata = sa.MetaData()
jobs = sa.Table(
    "jobs",
    metadata,
    sa.Column("number", _number, primary_key=True, autoincrement=True),
    sa.Column("id", sa.String, unique=True, nullable=False),
    sa.Column("state", sa.String, nullable=False, default=JobState.queued.value),
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
    sa.Column("progress", sa.JSON, nullable=False, default=lambda: Progress().model_dump(mode="json")),
    sa.Column("done", sa.Integer, nullable=False, default=0),
    sa.Column("attempts", sa.Integer, nullable=False, default=0),
    sa.Column("lost", sa.Integer, nullable=False, default=0),
    sa.Column("events", sa.Integer, nullable=False, default=1),
    sa.Column("cancel_requested", sa.Boolean, nullable=False, default=False),
    sa.Column("error", sa.String),
    sa.Column("note", sa.String),
    sa.Column("artifacts", sa.JSON, nullable=False, default=list),
    sa.Column("names", sa.JSON, nullable=False, server_default="{}"),
    sa.Column("seen", sa.Double),
    sa.Column("orphaned", sa.Integer, nullable=False, server_default="0"),
    sqlite_autoincrement=True,
)
"""``attempts`` counts claims, and an attempt must name itself to write; ``lost`` counts attempts lost since the last
finished phase, ``orphaned`` those lost together with their dispatcher; ``done`` counts finished phases; ``events``
counts the rows in ``job_events``; ``needs`` is JSON without defaults; ``seen`` is the time of the attempt's last
heartbeat, before the first one the time at which it is due.
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
"""Index of the jobs by label."""

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
    sa.Column("fault", sa.String),
)

leases = sa.Table(
    "leases",
    metadata,
    sa.Column("name", sa.String, primary_key=True),
    sa.Column("until", sa.Double, nullable=False),
    sa.Column("holder", sa.String, nullable=False, server_default=""),
)
"""Work done by one process at a time. ``until``: end of the holder's lease."""


def fresh(connection: sa.Connection, job: str, *, lock: bool = False) -> Row:
    """The row of a job; ``lock`` it until the transaction ends. Raises ``NotFoundError``."""
    query = sa.select(jobs).where(jobs.c.id == job)
    row = connection.execute(query.with_for_update() if lock else query).one_or_none()
    if row is None:
        raise NotFoundError(f"There is no job {job!r}. List the jobs to find its id.")
    return row


def update_job(connection: sa.Connection, job: str, *, message: str | None = None, **values: Any) -> Row:
    """Change a job and append an event with its new state. Returns the new row."""
    change = jobs.update().where(jobs.c.id == job).values(events=jobs.c.events + 1, **values).returning(jobs)
    row = connection.execute(change).one()
    append_event(connection, row, message)
    return row


def append_event(connection: sa.Connection, row: Row, message: str | None) -> None:
    """Write event number ``row.events`` with the current state of the job."""
    values = {"job": row.id, "id": row.events, "state": row.state, "progress": row.progress, "message": message}
    connection.execute(events.insert().values(time=clock(), **values))


def needs_text(needs: Needs) -> str:
    """The needs as the column has them: the same text for the same needs."""
    return needs.model_dump_json(exclude_defaults=True)


def time_of(seconds: float | None) -> datetime | None:
    """Seconds since 1970 as a UTC time."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


_PRIORITY_NAMES: Final = {number: name for name, number in PRIORITIES.items()}


def job_of(row: Row) -> Job:
    """Convert a row of ``jobs`` to the API's model. Raises pydantic's ``ValidationError`` for a malformed row."""
    same = {name: getattr(row, name) for name in Job.model_fields}
    times = {name: time_of(getattr(row, name)) for name in ("created", "started", "finished")}
    asked = {"priority": _PRIORITY_NAMES.get(row.priority, row.priority), "needs": json.loads(row.needs)}
    return Job.model_validate(same | times | asked)


def event_of(row: Row) -> Event:
    """Convert a row of ``job_events`` to the API's model."""
    return Event.model_validate({name: getattr(row, name) for name in Event.model_fields} | {"time": time_of(row.time)})
