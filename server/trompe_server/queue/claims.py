"""A worker's view of the queue: claim a job, report progress, end the job or give it back.

Each claim starts a new attempt, and every write names its attempt. After another worker has claimed the job, writes of
the old attempt raise ``LostJobError``, so a worker that was frozen and comes back changes nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import sqlalchemy as sa

from trompe_server.errors import NotFoundError
from trompe_server.queue.tables import Row, fresh, job_of, jobs, locked, update_job
from trompe_server.storage.database import clock, write
from trompe_shared.api import Job, JobState, Progress

__all__ = ["MAX_LOST", "Claim", "Claims", "Ending", "LostJobError", "lose"]

MAX_LOST: Final = 3
"""Workers that may die in the same phase of a job before the job is failed."""


class LostJobError(Exception):
    """The attempt is over: another worker has the job, or the job has ended."""


@dataclass(frozen=True)
class Claim:
    """A job held by a worker. ``attempt`` counts from 1; ``done`` is the number of finished phases."""

    job: Job
    attempt: int
    done: int


@dataclass(frozen=True)
class Ending:
    """Final state of a job, with a reason for the user in ``error`` or ``note``."""

    state: JobState
    error: str | None = None
    note: str | None = None
    progress: Progress | None = None
    public: tuple[str, ...] = ()


class Claims:
    """Claims of ``worker`` on the jobs in the database of ``engine``. Every call may be repeated after an outage."""

    def __init__(self, engine: sa.Engine, worker: str) -> None:
        self._engine, self.worker = engine, worker

    def claim(self, needs: Sequence[str]) -> Claim | None:
        """Claim the next queued job with one of these ``needs``; ``None`` if there is none."""
        if not self._any(_queued(needs)) and not self._any(self._mine()):
            return None
        with write(self._engine) as connection:
            mine = connection.execute(sa.select(jobs).where(self._mine())).first()
            if mine is not None:  # the answer to the last claim was lost
                return _claim(mine)
            found = [row for need in needs if (row := _next(connection, need)) is not None]
            return self._take(connection, min(found, key=lambda row: (row.priority, row.number))) if found else None

    def _take(self, connection: sa.Connection, row: Row) -> Claim:
        message = "started" if row.attempts == 0 else f"continued by {self.worker}"
        values = {"state": JobState.running.value, "worker": self.worker, "attempts": row.attempts + 1}
        started = sa.func.coalesce(jobs.c.started, clock())
        return _claim(update_job(connection, row.id, message=message, started=started, **values))

    def advance(
        self, claim: Claim, progress: Progress, *, done: int | None = None, public: tuple[str, ...] = ()
    ) -> bool:
        """Write progress, the number of finished phases and public artifacts. Returns whether to cancel the job."""
        with write(self._engine) as connection:
            row = _held(connection, claim)
            values: dict[str, Any] = {"progress": progress.model_dump(mode="json")}
            if done is not None:
                values |= {"done": done, "artifacts": list(dict.fromkeys([*row.artifacts, *public]))}
                values |= {"lost": 0} if done > row.done else {}
            update_job(connection, row.id, **values)
            return bool(row.cancel_requested)

    def finish(self, claim: Claim, ending: Ending) -> list[str]:
        """End the job and return its artifacts. Ending it again in the same attempt changes nothing."""
        with write(self._engine) as connection:
            row = locked(connection, claim.job.id)
            if JobState(row.state).final and row.attempts == claim.attempt:
                return list(row.artifacts)
            row = _held(connection, claim)
            progress = row.progress if ending.progress is None else ending.progress.model_dump(mode="json")
            artifacts = list(dict.fromkeys([*row.artifacts, *ending.public]))
            end = {"state": ending.state.value, "error": ending.error, "note": ending.note}
            more = {"progress": progress, "artifacts": artifacts, "finished": clock()}
            update_job(connection, row.id, message=ending.error or ending.note, **end, **more)
            return artifacts

    def give_back(self, claim: Claim) -> None:
        """Requeue the job at an orderly stop of the worker. It does not count as lost."""
        with write(self._engine) as connection:
            row = _held(connection, claim)
            message = "the worker stopped; the next one continues the job"
            update_job(connection, row.id, message=message, state=JobState.queued.value)

    def holds(self, claim: Claim) -> bool:
        """Return whether the claim is still valid."""
        with self._engine.connect() as connection:
            return _is_held(fresh(connection, claim.job.id), claim)

    def ended_artifacts(self, claim: Claim) -> list[str] | None:
        """Artifacts of the job if it has ended, none if it was deleted; ``None`` while it is queued or running."""
        try:
            with self._engine.connect() as connection:
                row = fresh(connection, claim.job.id)
        except NotFoundError:
            return []
        return list(row.artifacts) if JobState(row.state).final else None

    def _any(self, condition: sa.ColumnElement[bool]) -> bool:
        """Return whether such a job exists, without a lock."""
        with self._engine.connect() as connection:
            return connection.execute(sa.select(jobs.c.number).where(condition).limit(1)).first() is not None

    def _mine(self) -> sa.ColumnElement[bool]:
        return sa.and_(jobs.c.state == JobState.running.value, jobs.c.worker == self.worker)


def lose(connection: sa.Connection, row: Row, reason: str) -> None:
    """Take a running job from its dead worker: requeue it, or fail it at ``MAX_LOST`` lost workers."""
    lost = row.lost + 1
    ended = {"lost": lost, "finished": clock()}
    if row.cancel_requested:
        update_job(connection, row.id, message="cancelled", state=JobState.cancelled.value, **ended)
    elif lost >= MAX_LOST:
        error = f"{lost} workers died while running this job; it is not retried. Last cause: {reason}."
        update_job(connection, row.id, message=error, state=JobState.failed.value, error=error, **ended)
    else:
        update_job(connection, row.id, message=reason, state=JobState.queued.value, lost=lost)


def _queued(needs: Sequence[str]) -> sa.ColumnElement[bool]:
    return sa.and_(jobs.c.state == JobState.queued.value, jobs.c.needs.in_(needs))


def _next(connection: sa.Connection, need: str) -> Row | None:
    """The next job with this need, except jobs another worker is claiming right now."""
    query = sa.select(jobs).where(_queued([need])).order_by(jobs.c.priority, jobs.c.number).limit(1)
    return connection.execute(query.with_for_update(skip_locked=True)).first()


def _held(connection: sa.Connection, claim: Claim) -> Row:
    row = locked(connection, claim.job.id)
    if not _is_held(row, claim):
        raise LostJobError(
            f"Attempt {claim.attempt} of job {row.id} is over: the job is {row.state} in attempt {row.attempts}."
        )
    return row


def _is_held(row: Row, claim: Claim) -> bool:
    return bool(row.state == JobState.running.value and row.attempts == claim.attempt)


def _claim(row: Row) -> Claim:
    return Claim(job_of(row), row.attempts, row.done)
