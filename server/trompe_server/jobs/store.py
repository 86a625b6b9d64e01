"""The record of jobs as those see it who submit and watch them. What workers do with it is in ``desk``."""

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from trompe_server.database import clock, connect, write
from trompe_server.errors import ConflictError
from trompe_server.jobs.migrate import migrate
from trompe_server.jobs.tables import (
    PRIORITIES,
    append_event,
    event_of,
    events,
    fresh,
    job_of,
    jobs,
    labels,
    locked,
    spec_of,
    time_of,
    totals,
    update_job,
    workers,
)
from trompe_shared.api import Event, Job, JobList, JobRequest, JobState, Progress, WorkerInfo
from trompe_shared.errors import SpecError

__all__ = ["JobGroup", "JobStore", "Statistics"]


@dataclass(frozen=True)
class Statistics:
    """The whole service at one moment. ``oldest_queued``: seconds that the oldest queued job waits, 0 without one.

    The others are sums over all workers since the beginning: steps of attacks and their seconds, images that
    classifiers were shown and their seconds, images that the target rendered and its seconds.
    """

    jobs: Mapping[JobState, int]
    oldest_queued: float
    attack_steps: float = 0.0
    step_seconds: float = 0.0
    classifier_images: float = 0.0
    classifier_seconds: float = 0.0
    target_renders: float = 0.0
    target_seconds: float = 0.0


@dataclass(frozen=True)
class JobGroup:
    """Jobs that have the same value of a label: how many in which state, and when the first was made."""

    value: str
    counts: Mapping[JobState, int]
    created: datetime


class JobStore:
    """Jobs and their events in the database at ``url``. Safe to use from many threads and processes.

    Every method raises ``DatabaseDownError``, a ``ServiceError``, where the database cannot be reached.
    """

    def __init__(self, url: str, *, silence: float = 30.0) -> None:
        self._silence = silence
        self.engine = connect(url)

    def migrate(self) -> None:
        """Make the tables, or bring them up to date."""
        migrate(self.engine)

    def close(self) -> None:
        """Let go of the database."""
        self.engine.dispose()

    def create(self, request: JobRequest, *, idempotency_key: str | None = None) -> tuple[Job, bool]:
        """A new queued job, and whether it is new: the same ``idempotency_key`` gives the job that it gave before.

        Raises ``ConflictError`` where the key came with another request.
        """
        try:
            with write(self.engine) as connection:
                return self._create(connection, request, idempotency_key)
        except IntegrityError:  # the same key at the same time, which has made the job meanwhile
            with write(self.engine) as connection:
                return self._create(connection, request, idempotency_key)

    def _create(self, connection: sa.Connection, request: JobRequest, key: str | None) -> tuple[Job, bool]:
        if key is not None:
            known = connection.execute(sa.select(jobs).where(jobs.c.idempotency_key == key)).one_or_none()
            if known is not None:
                return _the_same(job_of(known), request, key), False
        row = connection.execute(jobs.insert().values(_row(request, key)).returning(jobs)).one()
        if request.labels:
            pairs = [{"key": name, "value": value, "number": row.number} for name, value in request.labels.items()]
            connection.execute(labels.insert(), pairs)
        append_event(connection, row, "queued")
        return job_of(row), True

    def get(self, job: str) -> Job:
        """The job with this id. Raises ``NotFoundError``."""
        with self.engine.connect() as connection:
            return job_of(fresh(connection, job))

    def not_understood(self, job: str) -> list[str]:
        """The options of a job that only another version of Trompe understands. Raises ``NotFoundError``."""
        with self.engine.connect() as connection:
            return spec_of(fresh(connection, job))[1]

    def page(
        self,
        *,
        state: JobState | None = None,
        labels: Mapping[str, str] | None = None,
        object: str | None = None,
        classifier: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> JobList:
        """One page of jobs, newest first, of those that fit all filters. Raises ``SpecError`` for a cursor not ours."""
        filters = {"state": state, "object": object, "classifier": classifier}
        query = sa.select(jobs).where(*(jobs.c[name] == value for name, value in filters.items() if value is not None))
        number: sa.ColumnElement[int] = jobs.c.number
        for key, value in (labels or {}).items():
            having = _having(key, value)
            query = query.join(having, having.c.number == jobs.c.number)
            number = having.c.number  # the order of the index of labels is the order of the page
        if cursor is not None:
            query = query.where(number < _number(cursor))
        with self.engine.connect() as connection:
            rows = connection.execute(query.order_by(number.desc()).limit(limit + 1)).all()
        page = rows[:limit]
        return JobList(
            jobs=[job_of(row) for row in page], next_cursor=str(page[-1].number) if len(rows) > limit else None
        )

    def groups(self, key: str) -> list[JobGroup]:
        """The values of a label, those of the newest jobs first."""
        first = sa.func.min(jobs.c.created).label("first")
        query = sa.select(labels.c.value, jobs.c.state, sa.func.count().label("amount"), first)
        query = query.join(jobs, jobs.c.number == labels.c.number).where(labels.c.key == key)
        found: dict[str, tuple[dict[JobState, int], float]] = {}
        with self.engine.connect() as connection:
            for row in connection.execute(query.group_by(labels.c.value, jobs.c.state)):
                counts, created = found.get(row.value, ({}, row.first))
                found[row.value] = counts | {JobState(row.state): row.amount}, min(created, row.first)
        newest = sorted(found.items(), key=lambda item: item[1][1], reverse=True)
        return [JobGroup(value, counts, time_of(created)) for value, (counts, created) in newest]  # type: ignore[arg-type]

    def counts(self) -> dict[JobState, int]:
        """How many jobs there are in each state."""
        query = sa.select(jobs.c.state, sa.func.count().label("amount")).group_by(jobs.c.state)
        with self.engine.connect() as connection:
            found = {row.state: row.amount for row in connection.execute(query)}
        return {state: found.get(state.value, 0) for state in JobState}

    def events(self, job: str, *, after: int = 0) -> list[Event]:
        """Events of a job with ids above ``after``, oldest first."""
        query = sa.select(events).where(events.c.job == job, events.c.id > after).order_by(events.c.id)
        with self.engine.connect() as connection:
            return [event_of(row) for row in connection.execute(query)]

    def request_cancel(self, job: str) -> Job:
        """Cancel a queued job at once, and ask the worker of a running one to stop. Raises ``NotFoundError``."""
        with write(self.engine) as connection:
            row = locked(connection, job)
            if row.state == JobState.queued:
                end = {"state": JobState.cancelled.value, "finished": clock()}
                row = update_job(connection, job, message="cancelled before it started", **end)
            elif row.state == JobState.running and not row.cancel_requested:
                row = update_job(connection, job, message="cancel requested", cancel_requested=True)
            return job_of(row)

    def delete(self, job: str) -> None:
        """Forget a job that has ended; its artifacts are the caller's. Raises ``NotFoundError``, ``ConflictError``."""
        with write(self.engine) as connection:
            row = locked(connection, job)
            if not JobState(row.state).final:
                raise ConflictError(
                    f"Job {job} is {row.state}: only jobs that have ended can be deleted. Cancel it first."
                )
            forget(connection, [row])

    def ended_before(self, seconds: float, *, limit: int = 100) -> list[str]:
        """Ids of jobs that ended more than so many seconds ago, the oldest first."""
        query = sa.select(jobs.c.id).where(jobs.c.finished < clock() - seconds).order_by(jobs.c.finished).limit(limit)
        with self.engine.connect() as connection:
            return list(connection.execute(query).scalars())

    def workers(self) -> list[WorkerInfo]:
        """The workers that there are or lately were."""
        alive = (workers.c.seen > clock() - self._silence).label("alive")
        with self.engine.connect() as connection:
            rows = connection.execute(sa.select(workers, alive).order_by(workers.c.id)).all()
        return [
            WorkerInfo.model_validate(
                {name: getattr(row, name) for name in ("id", "host", "device", "alive", "job")}
                | {"started": time_of(row.started), "seen": time_of(row.seen)}
            )
            for row in rows
        ]

    def statistics(self) -> Statistics:
        """Figures of the whole service."""
        oldest = sa.select(clock() - jobs.c.created).where(jobs.c.state == JobState.queued.value)
        with self.engine.connect() as connection:
            waits = connection.execute(oldest.order_by(jobs.c.number).limit(1)).scalar_one_or_none()
            sums: dict[str, float] = {row.name: row.value for row in connection.execute(sa.select(totals))}
        return Statistics(self.counts(), max(0.0, waits or 0.0), **sums)


def forget(connection: sa.Connection, rows: list[Any]) -> None:
    """Delete jobs with all that the database knows of them."""
    numbers = [row.number for row in rows]
    connection.execute(labels.delete().where(labels.c.number.in_(numbers)))
    connection.execute(events.delete().where(events.c.job.in_([row.id for row in rows])))
    connection.execute(jobs.delete().where(jobs.c.number.in_(numbers)))


def _row(request: JobRequest, key: str | None) -> dict[str, Any]:
    spec = request.spec().model_dump(mode="json")
    return _NEW | {
        "id": secrets.token_hex(8),
        "spec": spec,
        "object": request.object,
        "classifier": request.classifier,
        "priority": PRIORITIES[request.priority],
        "needs": request.needs,
        "labels": request.labels,
        "idempotency_key": key,
        "created": clock(),
    }


_NEW: Final = {
    "state": JobState.queued.value,
    "progress": Progress().model_dump(mode="json"),
    "done": 0,
    "attempts": 0,
    "lost": 0,
    "events": 1,
    "cancel_requested": False,
    "artifacts": [],
}


def _the_same(job: Job, request: JobRequest, key: str) -> Job:
    """``job``, if it is what ``request`` asks for."""
    if (job.spec, job.priority, job.labels, job.needs) != (
        request.spec(),
        request.priority,
        request.labels,
        request.needs,
    ):
        raise ConflictError(
            f"The idempotency key {key!r} came with another request before, which made job {job.id}; "
            "use a new key for a new request."
        )
    return job


def _having(key: str, value: str) -> sa.Subquery:
    """The numbers of the jobs with this label."""
    return sa.select(labels.c.number).where(labels.c.key == key, labels.c.value == value).subquery()


def _number(cursor: str) -> int:
    if not (cursor.isdecimal() and cursor.isascii() and len(cursor) < 19):
        raise SpecError(f"{cursor!r} is not a cursor; pass next_cursor of the page before.")
    return int(cursor)
