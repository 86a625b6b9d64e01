"""The API's view of the queue: submit, list, cancel and delete jobs. ``claims`` is the workers' view."""

import secrets
from collections.abc import Mapping
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from trompe_server.errors import ConflictError
from trompe_server.queue.migrations import upgrade
from trompe_server.queue.tables import (
    PRIORITIES,
    Row,
    append_event,
    event_of,
    events,
    fresh,
    job_of,
    jobs,
    labels,
    needs_text,
    time_of,
    update_job,
    workers,
)
from trompe_server.storage.database import clock, connect, write
from trompe_shared.api import (
    Event,
    ExperimentInfo,
    Job,
    JobList,
    JobRequest,
    JobState,
    JudgementRequest,
    WorkerInfo,
)
from trompe_shared.errors import SpecError

AnyRequest = JobRequest | JudgementRequest

EXPERIMENT: Final = "experiment"
"""Label of the jobs of an experiment, with its name."""


class JobStore:
    """Jobs and their events in the database at ``url``. Safe to use from many threads and processes.

    Every method raises ``DatabaseDownError``, a ``ServiceError``, if the database cannot be reached.
    ``silence``: seconds without being seen after which a worker counts as dead.
    """

    def __init__(self, url: str, *, silence: float = 30.0) -> None:
        self._silence = silence
        self.engine = connect(url)

    def migrate(self) -> None:
        """Create or upgrade the tables. Raises ``ServiceError`` for tables of version 0.1."""
        upgrade(self.engine)

    def close(self) -> None:
        self.engine.dispose()

    def create(
        self, request: AnyRequest, *, names: Mapping[str, str] | None = None, idempotency_key: str | None = None
    ) -> tuple[Job, bool]:
        """Queue a job. Returns the job and whether it is new: the same ``idempotency_key`` returns the same job.

        ``names``: of the stored things in the request, by id. Raises ``ConflictError`` if the key was used with another
        request.
        """
        row = _row(request, names or {}, idempotency_key)
        try:
            return self._create(request, row)
        except IntegrityError:  # a request with the same key created the job meanwhile
            return self._create(request, row)

    def _create(self, request: AnyRequest, values: dict[str, Any]) -> tuple[Job, bool]:
        key = values["idempotency_key"]
        with write(self.engine) as connection:
            if key is not None:
                known = connection.execute(sa.select(jobs).where(jobs.c.idempotency_key == key)).one_or_none()
                if known is not None:
                    return _the_same(job_of(known), request, key), False
            row = connection.execute(jobs.insert().values(values).returning(jobs)).one()
            if request.labels:
                pairs = [{"key": name, "value": value, "number": row.number} for name, value in request.labels.items()]
                connection.execute(labels.insert(), pairs)
            append_event(connection, row, "queued")
            return job_of(row), True

    def get(self, job: str) -> Job:
        """The job with this id. Raises ``NotFoundError``."""
        with self.engine.connect() as connection:
            return job_of(fresh(connection, job))

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
        """One page of the jobs that match all filters, newest first. Raises ``SpecError`` for an invalid cursor."""
        filters = {"state": state, "object": object, "classifier": classifier}
        query = sa.select(jobs).where(*(jobs.c[name] == value for name, value in filters.items() if value is not None))
        number: sa.ColumnElement[int] = jobs.c.number
        for key, value in (labels or {}).items():
            having = _having(key, value)
            query = query.join(having, having.c.number == jobs.c.number)
            number = having.c.number  # sorted by the index of labels
        if cursor is not None:
            query = query.where(number < _number(cursor))
        with self.engine.connect() as connection:
            rows = connection.execute(query.order_by(number.desc()).limit(limit + 1)).all()
        page = rows[:limit]
        return JobList(
            jobs=[job_of(row) for row in page], next_cursor=str(page[-1].number) if len(rows) > limit else None
        )

    def experiments(self) -> list[ExperimentInfo]:
        """Jobs grouped by the value of the label ``EXPERIMENT``, newest group first."""
        first = sa.func.min(jobs.c.created).label("first")
        query = sa.select(labels.c.value, jobs.c.state, sa.func.count().label("amount"), first)
        query = query.join(jobs, jobs.c.number == labels.c.number).where(labels.c.key == EXPERIMENT)
        found: dict[str, tuple[dict[JobState, int], float]] = {}
        with self.engine.connect() as connection:
            for row in connection.execute(query.group_by(labels.c.value, jobs.c.state)):
                counts, created = found.get(row.value, ({}, row.first))
                found[row.value] = counts | {JobState(row.state): row.amount}, min(created, row.first)
        newest = sorted(found.items(), key=lambda item: item[1][1], reverse=True)
        return [
            ExperimentInfo.model_validate({"name": value, "jobs": counts, "created": time_of(created)})
            for value, (counts, created) in newest
        ]

    def counts(self) -> dict[JobState, int]:
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
            row = fresh(connection, job, lock=True)
            if row.state == JobState.queued:
                end = {"state": JobState.cancelled.value, "finished": clock()}
                row = update_job(connection, job, message="cancelled before it started", **end)
            elif row.state == JobState.running and not row.cancel_requested:
                row = update_job(connection, job, message="cancel requested", cancel_requested=True)
            return job_of(row)

    def check_ended(self, job: str) -> None:
        """Raise ``ConflictError`` for a job that has not ended, ``NotFoundError`` for an unknown one."""
        with self.engine.connect() as connection:
            _check_ended(fresh(connection, job))

    def delete(self, job: str) -> None:
        """Delete the rows of an ended job; see ``retention.delete_job`` for its files.

        Raises ``NotFoundError`` and ``ConflictError``.
        """
        with write(self.engine) as connection:
            row = fresh(connection, job, lock=True)
            _check_ended(row)
            connection.execute(labels.delete().where(labels.c.number == row.number))
            connection.execute(events.delete().where(events.c.job == job))
            connection.execute(jobs.delete().where(jobs.c.number == row.number))

    def ended_before(self, seconds: float, *, limit: int) -> list[str]:
        """Ids of at most ``limit`` jobs that ended more than ``seconds`` ago, oldest first."""
        query = sa.select(jobs.c.id).where(jobs.c.finished < clock() - seconds).order_by(jobs.c.finished).limit(limit)
        with self.engine.connect() as connection:
            return list(connection.execute(query).scalars())

    def workers(self) -> list[WorkerInfo]:
        """Recorded workers with their running jobs, dead ones included."""
        alive = (workers.c.seen > clock() - self._silence).label("alive")
        running = sa.select(jobs.c.worker, jobs.c.id).where(jobs.c.state == JobState.running.value)
        with self.engine.connect() as connection:
            rows = connection.execute(sa.select(workers, alive).order_by(workers.c.id)).all()
            at_work = connection.execute(running.order_by(jobs.c.number)).all()
        return [
            WorkerInfo.model_validate(
                dict(row._mapping)
                | {"started": time_of(row.started), "seen": time_of(row.seen)}
                | {"jobs": [job.id for job in at_work if job.worker == row.id]}
            )
            for row in rows
        ]

    def oldest_queued(self) -> float:
        """Wait of the oldest queued job, seconds; 0 without one."""
        oldest = sa.select(clock() - jobs.c.created).where(jobs.c.state == JobState.queued.value)
        with self.engine.connect() as connection:
            waits = connection.execute(oldest.order_by(jobs.c.number).limit(1)).scalar_one_or_none()
        return max(0.0, waits or 0.0)


def _check_ended(row: Row) -> None:
    if not JobState(row.state).final:
        raise ConflictError(f"Job {row.id} is {row.state}: only ended jobs can be deleted. Cancel it first.")


def _row(request: AnyRequest, names: Mapping[str, str], key: str | None) -> dict[str, Any]:
    spec = request.spec().model_dump(mode="json")
    return {
        "id": secrets.token_hex(8),
        "spec": spec,
        "names": dict(names),
        "object": request.before if isinstance(request, JudgementRequest) else request.object,
        "classifier": _network(request),
        "priority": PRIORITIES[request.priority],
        "needs": needs_text(request.needs),
        "labels": request.labels,
        "idempotency_key": key,
        "created": clock(),
    }


def _network(request: AnyRequest) -> str:
    """The network that a job is listed under."""
    if isinstance(request, JudgementRequest):
        return next(iter(request.networks), "")
    return request.victim.classifier


def _the_same(job: Job, request: AnyRequest, key: str) -> Job:
    """Return ``job``; raise ``ConflictError`` if ``request`` asks for another one."""
    asked = (request.spec(), request.priority, request.labels, request.needs)
    if (job.spec, job.priority, job.labels, job.needs) != asked:
        raise ConflictError(
            f"The idempotency key {key!r} was used with another request (job {job.id}). "
            "Use a new key for a new request."
        )
    return job


def _having(key: str, value: str) -> sa.Subquery:
    """Numbers of the jobs with this label."""
    return sa.select(labels.c.number).where(labels.c.key == key, labels.c.value == value).subquery()


def _number(cursor: str) -> int:
    if not (cursor.isdecimal() and cursor.isascii() and len(cursor) < 19):
        raise SpecError(f"{cursor!r} is not a cursor. Pass next_cursor of the previous page.")
    return int(cursor)
