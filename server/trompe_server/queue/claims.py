"""The queue as its dispatcher and the attempts see it: claim a job, report progress, end the job or give it back.

Each claim starts a new attempt, and every write names its attempt. After the job was claimed again, writes of the old
attempt raise ``LostJobError``, so a worker that was frozen and comes back changes nothing.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, Final

import sqlalchemy as sa

from trompe_server.errors import NotFoundError
from trompe_server.queue.tables import Row, events, fresh, job_of, jobs, needs_text, update_job
from trompe_server.storage.database import clock, write
from trompe_shared.api import Job, JobState, Needs, Progress

MAX_LOST: Final = 3
"""Attempts that may be lost in the same phase of a job before the job is failed."""

MAX_ORPHANED: Final = 10
"""The same for attempts lost together with their dispatcher: the cause may be another job, or none."""

ALONE_AFTER: Final = 5
"""Attempts of a job orphaned in the same phase after which it runs alone, so that no other job is failed with it."""

START_ALLOWANCE: Final = 60.0
"""Seconds an attempt has until its first heartbeat is due: its process may have to start and to import torch."""

MOST_TOLD: Final = 500
"""Jobs told in one transaction why they wait."""
_RUNNING: Final = jobs.c.state == JobState.running.value


class LostJobError(Exception):
    """The attempt is over: the job is queued again, has a newer attempt, or has ended."""


@dataclass(frozen=True)
class Claim:
    """A job held by an attempt. ``attempt`` counts from 1; ``done`` is the number of finished phases."""

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
    """Claims on the jobs in the database of ``engine``. Every call but ``claim`` may be repeated after an outage."""

    def __init__(self, engine: sa.Engine) -> None:
        self.engine = engine

    def now(self) -> float:
        """Time of the database, seconds since 1970."""
        with self.engine.connect() as connection:
            return connection.execute(sa.select(clock())).scalar_one()

    def waiting(self) -> dict[Needs, int]:
        """Number of queued jobs by their needs."""
        query = sa.select(jobs.c.needs, sa.func.count().label("amount")).where(jobs.c.state == JobState.queued.value)
        with self.engine.connect() as connection:
            rows = connection.execute(query.group_by(jobs.c.needs)).all()
        return {Needs.model_validate_json(row.needs): row.amount for row in rows}

    def upcoming(self) -> list[Needs]:
        """Different needs of the queued jobs; first those of the job to run next. Takes no longer for more jobs.

        A job orphaned ``ALONE_AFTER`` times waits until no other runs, as do the jobs behind it until it gets on.
        """
        found, text = list[tuple[int, int, int, Needs]](), ""
        following = sa.select(sa.func.min(jobs.c.needs)).where(jobs.c.state == JobState.queued.value)
        with self.engine.connect() as connection:
            running = connection.scalar(sa.select(sa.func.max(jobs.c.orphaned)).where(_RUNNING))
            while (text := connection.scalar(following.where(jobs.c.needs > text))) is not None:
                needs = Needs.model_validate_json(text)
                if (first := connection.execute(_first(needs)).first()) is not None:  # not cancelled meanwhile
                    found.append((first.priority, first.number, first.orphaned, needs))
        ordered = sorted(found, key=lambda each: each[:2])
        if running is not None:
            ordered = list(takewhile(lambda each: max(running, each[2]) < ALONE_AFTER, ordered))
        return [needs for *_, needs in ordered]

    def claim(self, needs: Needs, worker: str) -> Claim | None:
        """Claim the next queued job with these ``needs`` for ``worker``; ``None`` if there is none.

        A claim whose answer is lost is a running job that the dispatcher does not know: ``lose_unknown``.
        """
        query = _first(needs).with_only_columns(*jobs.c)
        with write(self.engine) as connection:
            row = connection.execute(query.with_for_update(skip_locked=True)).first()
            return None if row is None else _take(connection, row, worker)

    def explain(self, reasons: Mapping[Needs, str]) -> None:
        """Tell the queued jobs with these needs why they wait, ``MOST_TOLD`` at a time."""
        for needs, reason in reasons.items():
            told = sa.and_(_queued(needs), jobs.c.note.is_distinct_from(reason))
            some = sa.select(jobs.c.id).where(told).limit(MOST_TOLD).with_for_update()
            with write(self.engine) as connection:
                for job in connection.execute(some).scalars().all():
                    update_job(connection, job, message=reason, note=reason)

    def advance(
        self, claim: Claim, progress: Progress, *, done: int | None = None, public: tuple[str, ...] = ()
    ) -> bool:
        """Write progress, the number of finished phases and public artifacts. Returns whether to cancel the job."""
        with write(self.engine) as connection:
            row = _held(connection, claim)
            values: dict[str, Any] = {"progress": progress.model_dump(mode="json")}
            if done is not None:
                values |= {"done": done, "artifacts": list(dict.fromkeys([*row.artifacts, *public]))}
                values |= {"lost": 0, "orphaned": 0} if done > row.done else {}
            update_job(connection, row.id, **values)
            return bool(row.cancel_requested)

    def finish(self, claim: Claim, ending: Ending) -> list[str]:
        """End the job and return its artifacts. Ending it again in the same attempt changes nothing."""
        with write(self.engine) as connection:
            row = fresh(connection, claim.job.id, lock=True)
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
        """Requeue the job at an orderly stop, or cancel it if that was asked. It does not count as lost."""
        with write(self.engine) as connection:
            row = _held(connection, claim)
            _requeue(connection, row, "the worker stopped; the next one continues the job")

    def lose(self, claim: Claim, reason: str) -> None:
        """Take the job from its attempt, which died or stands still, unless the attempt is over or the job deleted."""
        with suppress(NotFoundError), write(self.engine) as connection:
            row = fresh(connection, claim.job.id, lock=True)
            if _is_held(row, claim):
                _lose(connection, row, reason, jobs.c.lost)

    def lose_unknown(self, known: Mapping[str, Claim], reason: str) -> list[str]:
        """Take the running jobs whose attempts are not ``known`` (by job): they are orphaned. Returns their ids."""
        ours = {job: claim.attempt for job, claim in known.items()}
        running = sa.select(jobs.c.id, jobs.c.attempts).where(_RUNNING)
        with self.engine.connect() as connection:
            unknown = [row.id for row in connection.execute(running) if ours.get(row.id) != row.attempts]
        for job in unknown:
            with write(self.engine) as connection:
                row = fresh(connection, job, lock=True)
                if row.state == JobState.running and ours.get(job) != row.attempts:
                    _lose(connection, row, reason, jobs.c.orphaned)
        return unknown

    def beat(self, claim: Claim) -> None:
        """Note that the attempt lives, unless it is over."""
        held = sa.and_(jobs.c.id == claim.job.id, jobs.c.attempts == claim.attempt, _RUNNING)
        with write(self.engine) as connection:
            connection.execute(jobs.update().where(held).values(seen=clock()))

    def silent(self, seconds: float) -> dict[str, int]:
        """Running jobs whose attempts have sent no heartbeat for ``seconds``: their attempts, by job.

        An attempt that never sent one has ``START_ALLOWANCE`` more.
        """
        query = sa.select(jobs.c.id, jobs.c.attempts).where(_RUNNING, jobs.c.seen < clock() - seconds)
        with self.engine.connect() as connection:
            return {row.id: row.attempts for row in connection.execute(query)}

    def still(self, seconds: float) -> dict[str, int]:
        """Running jobs without an event for ``seconds``: their attempts, by job."""
        last = sa.and_(events.c.job == jobs.c.id, events.c.id == jobs.c.events)
        query = sa.select(jobs.c.id, jobs.c.attempts).join(events, last)
        query = query.where(_RUNNING, events.c.time < clock() - seconds)
        with self.engine.connect() as connection:
            return {row.id: row.attempts for row in connection.execute(query)}

    def ended_artifacts(self, claim: Claim) -> list[str] | None:
        """Artifacts of the job if it has ended, none if it was deleted; ``None`` while it is queued or running."""
        try:
            with self.engine.connect() as connection:
                row = fresh(connection, claim.job.id)
        except NotFoundError:
            return []
        return list(row.artifacts) if JobState(row.state).final else None


def _take(connection: sa.Connection, row: Row, worker: str) -> Claim:
    message = "started" if row.attempts == 0 else f"continued by {worker}"
    values = {"state": JobState.running.value, "worker": worker, "attempts": row.attempts + 1}
    times = {"started": sa.func.coalesce(jobs.c.started, clock()), "seen": clock() + START_ALLOWANCE}
    taken = update_job(connection, row.id, message=message, note=None, **times, **values)
    return Claim(job_of(taken), taken.attempts, taken.done)


def _lose(connection: sa.Connection, row: Row, reason: str, counter: sa.Column[int]) -> None:
    """Requeue a running job, or fail it after too many losses of the kind that ``counter`` counts."""
    count = getattr(row, counter.name) + 1
    most, dead = (MAX_LOST, "workers") if counter is jobs.c.lost else (MAX_ORPHANED, "dispatchers")
    if count >= most and not row.cancel_requested:
        error = f"{count} {dead} died while running this job; it is not retried. Last cause: {reason}."
        ended = {counter.name: count, "finished": clock()}
        update_job(connection, row.id, message=error, state=JobState.failed.value, error=error, **ended)
    else:
        _requeue(connection, row, reason, **{counter.name: count})


def _requeue(connection: sa.Connection, row: Row, reason: str, **values: int) -> None:
    """Put a running job back into the queue, or cancel it, as it was asked to."""
    if row.cancel_requested:
        state = {"state": JobState.cancelled.value, "finished": clock()}
        update_job(connection, row.id, message="cancelled", **state, **values)
    else:
        update_job(connection, row.id, message=reason, state=JobState.queued.value, **values)


def _queued(needs: Needs) -> sa.ColumnElement[bool]:
    return sa.and_(jobs.c.state == JobState.queued.value, jobs.c.needs == needs_text(needs))


def _first(needs: Needs) -> sa.Select[tuple[int, int, int]]:
    """Priority, number and orphaned attempts of the queued job with these needs that runs next."""
    query = sa.select(jobs.c.priority, jobs.c.number, jobs.c.orphaned).where(_queued(needs))
    return query.order_by(jobs.c.priority, jobs.c.number).limit(1)


def _held(connection: sa.Connection, claim: Claim) -> Row:
    row = fresh(connection, claim.job.id, lock=True)
    if not _is_held(row, claim):
        raise LostJobError(
            f"Attempt {claim.attempt} of job {row.id} is over: the job is {row.state} in attempt {row.attempts}."
        )
    return row


def _is_held(row: Row, claim: Claim) -> bool:
    return bool(row.state == JobState.running.value and row.attempts == claim.attempt)
