"""The workers that there are: each writes a heartbeat by the database's clock, and looks after the jobs of the dead."""

import socket
from collections.abc import Mapping
from typing import Any, Final

import sqlalchemy as sa

from trompe_server.database import clock, write
from trompe_server.jobs.desk import lose
from trompe_server.jobs.tables import jobs, leases, totals, workers
from trompe_shared.api import JobState

__all__ = ["WorkerRoll", "take_lease"]

FORGOTTEN: Final = 86_400.0
"""Seconds after which a worker that is gone is struck off the roll."""


class WorkerRoll:
    """The entry of the worker ``worker`` in the database of ``engine``."""

    def __init__(self, engine: sa.Engine, worker: str, *, device: str) -> None:
        self._engine, self._worker, self._device = engine, worker, device

    def arrive(self) -> None:
        """Sign in. What is still running under this name was lost by the process that had the name before."""
        with write(self._engine) as connection:
            running = sa.select(jobs).where(jobs.c.state == JobState.running.value, jobs.c.worker == self._worker)
            for row in connection.execute(running.with_for_update()).all():
                lose(connection, row, f"{self._worker} ended without a word and was started again")
            self._enter(connection, started=clock())

    def beat(self, job: str | None, done: Mapping[str, float]) -> None:
        """Write that this worker lives and what it works on; ``done`` is added to the totals of all workers."""
        with write(self._engine) as connection:
            self._enter(connection, job=job)
            for name in sorted(name for name in done if done[name]):
                more = {"value": totals.c.value + done[name]}
                connection.execute(totals.update().where(totals.c.name == name).values(more))

    def _enter(self, connection: sa.Connection, **values: Any) -> None:
        """Renew the entry, or make it."""
        entry = {"host": socket.gethostname(), "device": self._device, "seen": clock(), "job": None} | values
        mine = workers.c.id == self._worker
        if connection.execute(workers.update().where(mine).values(entry)).rowcount == 0:
            connection.execute(workers.insert().values({"id": self._worker, "started": clock()} | entry))

    def leave(self) -> None:
        """Sign off."""
        with write(self._engine) as connection:
            connection.execute(workers.delete().where(workers.c.id == self._worker))

    def reap(self, silence: float) -> list[str]:
        """Take their jobs from workers that were silent for ``silence`` seconds; the ids of these jobs."""
        gone = sa.or_(workers.c.id.is_(None), workers.c.seen < clock() - silence)
        orphans = sa.select(jobs).outerjoin(workers, jobs.c.worker == workers.c.id)
        orphans = orphans.where(jobs.c.state == JobState.running.value, gone)
        with self._engine.connect() as connection:
            if connection.execute(orphans.limit(1)).first() is None:
                return []
        with write(self._engine) as connection:
            rows = connection.execute(orphans.with_for_update(of=jobs, skip_locked=True)).all()
            for row in rows:
                lose(connection, row, f"{row.worker} has been silent for {silence:.0f} s")
            long_gone = workers.c.seen < clock() - max(FORGOTTEN, silence)
            connection.execute(workers.delete().where(long_gone))
            return [row.id for row in rows]


def take_lease(engine: sa.Engine, name: str, *, seconds: float) -> bool:
    """Whether the work ``name`` is this process's to do now; then it is nobody else's for so many seconds."""
    free = sa.and_(leases.c.name == name, leases.c.until < clock())
    with write(engine) as connection:
        return connection.execute(leases.update().where(free).values(until=clock() + seconds)).rowcount == 1
