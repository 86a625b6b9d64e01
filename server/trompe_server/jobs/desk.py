"""The record of jobs as a worker sees it: take one, tell how it goes, end it or hand it back.

A worker that takes a job up gets the number of its attempt and names it whenever it writes. Once the job was given to
another, that number is out of date, and every write raises ``LostJobError``: so a worker that was frozen and comes back
does no harm.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import sqlalchemy as sa

from trompe_server.database import clock, write
from trompe_server.errors import NotFoundError
from trompe_server.jobs.tables import Row, fresh, job_of, jobs, locked, spec_of, update_job
from trompe_shared.api import Job, JobState, Progress

__all__ = ["MAX_LOST", "Claim", "Ending", "JobDesk", "LostJobError", "lose"]

logger = logging.getLogger(__name__)

MAX_LOST: Final = 3
"""A job that ended this many workers, one after the other in the same phase, is failed."""


class LostJobError(Exception):
    """The job is no longer this worker's: another one has it, or it has ended."""


@dataclass(frozen=True)
class Claim:
    """A job that a worker holds, as its ``attempt``-th. ``done`` of its phases were done before."""

    job: Job
    attempt: int
    done: int


@dataclass(frozen=True)
class Ending:
    """How a job ended, with a reason for people where there is one."""

    state: JobState
    error: str | None = None
    note: str | None = None
    progress: Progress | None = None
    public: tuple[str, ...] = ()


class JobDesk:
    """What the worker ``worker`` takes from and writes to the jobs in the database of ``engine``.

    Each call may be repeated after an outage, whether or not it got through before.
    """

    def __init__(self, engine: sa.Engine, worker: str) -> None:
        self._engine, self.worker = engine, worker
        self._foreign: set[str] = set()
        """Jobs with options that this version does not know."""

    def claim(self, needs: Sequence[str]) -> Claim | None:
        """Take the job that is next among those with one of these ``needs``; ``None`` where none waits.

        A job with options that only another version of Trompe knows is left to a worker of that version.
        """
        if not self._any(self._waits(needs)) and not self._any(self._mine()):
            return None
        with write(self._engine) as connection:
            mine = connection.execute(sa.select(jobs).where(self._mine())).first()
            if mine is not None:  # the answer to the last claim was lost
                if not self._is_foreign(mine):
                    return _claim(mine)
                update_job(connection, mine.id, message="left to another worker", state=JobState.queued.value)
            while found := [row for need in needs if (row := self._first(connection, need)) is not None]:
                row = min(found, key=lambda row: (row.priority, row.number))
                if not self._is_foreign(row):
                    return self._take(connection, row)
            return None

    def _is_foreign(self, row: Row) -> bool:
        _, options = spec_of(row)
        if options:
            self._foreign.add(row.id)
            logger.warning("job %s is left to a worker of another version: this one does not know %s", row.id, options)
        return bool(options)

    def _take(self, connection: sa.Connection, row: Row) -> Claim:
        message = "started" if row.attempts == 0 else f"goes on with {self.worker}"
        values = {"state": JobState.running.value, "worker": self.worker, "attempts": row.attempts + 1}
        started = sa.func.coalesce(jobs.c.started, clock())
        return _claim(update_job(connection, row.id, message=message, started=started, **values))

    def advance(
        self, claim: Claim, progress: Progress, *, done: int | None = None, public: tuple[str, ...] = ()
    ) -> bool:
        """Note progress, phases that are done, artifacts for the user. Returns whether the job shall be cancelled."""
        with write(self._engine) as connection:
            row = _held(connection, claim)
            values: dict[str, Any] = {"progress": progress.model_dump(mode="json")}
            if done is not None:
                values |= {"done": done, "artifacts": list(dict.fromkeys([*row.artifacts, *public]))}
                values |= {"lost": 0} if done > row.done else {}
            update_job(connection, row.id, **values)
            return bool(row.cancel_requested)

    def finish(self, claim: Claim, ending: Ending) -> list[str]:
        """End the job, once: that it has ended with this attempt already is well. Returns its artifacts."""
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
        """Leave the job to the next worker, as one does who stops in good order; it does not count as lost."""
        with write(self._engine) as connection:
            row = _held(connection, claim)
            message = "the worker stopped; the job goes on with the next one"
            update_job(connection, row.id, message=message, state=JobState.queued.value)

    def holds(self, claim: Claim) -> bool:
        """Whether the job is still this worker's."""
        with self._engine.connect() as connection:
            return _is_held(fresh(connection, claim.job.id), claim)

    def left(self, claim: Claim) -> list[str] | None:
        """The artifacts of a job that has ended, none of one that was deleted; ``None`` while it goes on."""
        try:
            with self._engine.connect() as connection:
                row = fresh(connection, claim.job.id)
        except NotFoundError:
            return []
        return list(row.artifacts) if JobState(row.state).final else None

    def _any(self, condition: sa.ColumnElement[bool]) -> bool:
        """Whether there is such a job, asked without a lock."""
        with self._engine.connect() as connection:
            return connection.execute(sa.select(jobs.c.number).where(condition).limit(1)).first() is not None

    def _waits(self, needs: Sequence[str]) -> sa.ColumnElement[bool]:
        waiting = [jobs.c.state == JobState.queued.value, jobs.c.needs.in_(needs)]
        return sa.and_(*waiting, jobs.c.id.not_in(self._foreign)) if self._foreign else sa.and_(*waiting)

    def _first(self, connection: sa.Connection, need: str) -> Row | None:
        """The next job with this need that nobody else is just taking."""
        query = sa.select(jobs).where(self._waits([need])).order_by(jobs.c.priority, jobs.c.number).limit(1)
        return connection.execute(query.with_for_update(skip_locked=True)).first()

    def _mine(self) -> sa.ColumnElement[bool]:
        return sa.and_(jobs.c.state == JobState.running.value, jobs.c.worker == self.worker)


def lose(connection: sa.Connection, row: Row, reason: str) -> None:
    """Take a running job from a worker that is gone: another one goes on with it, unless it ended too many."""
    lost = row.lost + 1
    ended = {"lost": lost, "finished": clock()}
    if row.cancel_requested:
        update_job(connection, row.id, message="cancelled", state=JobState.cancelled.value, **ended)
    elif lost >= MAX_LOST:
        error = f"{lost} workers died while they ran this job, so it is not tried again. The last one: {reason}."
        update_job(connection, row.id, message=error, state=JobState.failed.value, error=error, **ended)
    else:
        update_job(connection, row.id, message=reason, state=JobState.queued.value, lost=lost)


def _held(connection: sa.Connection, claim: Claim) -> Row:
    row = locked(connection, claim.job.id)
    if not _is_held(row, claim):
        raise LostJobError(
            f"Job {row.id} is {row.state} in attempt {row.attempts}; attempt {claim.attempt} of it is over."
        )
    return row


def _is_held(row: Row, claim: Claim) -> bool:
    return bool(row.state == JobState.running.value and row.attempts == claim.attempt)


def _claim(row: Row) -> Claim:
    return Claim(job_of(row), row.attempts, row.done)
