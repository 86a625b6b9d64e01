"""Registry of workers: their heartbeats by the database's clock, and the jobs of dead workers."""

import socket
from typing import Any, Final

import sqlalchemy as sa

from trompe_server.queue.claims import lose
from trompe_server.queue.tables import jobs, workers
from trompe_server.storage.database import clock, write
from trompe_shared.api import JobState

__all__ = ["WorkerRegistry"]

FORGOTTEN: Final = 86_400.0
"""Seconds of silence after which a worker's entry is deleted."""


class WorkerRegistry:
    """The entry of ``worker`` in the database of ``engine``."""

    def __init__(self, engine: sa.Engine, worker: str, *, device: str) -> None:
        self._engine, self._worker, self._device = engine, worker, device

    def register(self) -> None:
        """Make the entry. Jobs still running under this name were lost by the process that had the name before."""
        with write(self._engine) as connection:
            running = sa.select(jobs).where(jobs.c.state == JobState.running.value, jobs.c.worker == self._worker)
            for row in connection.execute(running.with_for_update()).all():
                lose(connection, row, f"{self._worker} died and was restarted")
            self._renew(connection, started=clock())

    def beat(self, job: str | None) -> None:
        """Write a heartbeat. ``job`` is the id of the running job, if any."""
        with write(self._engine) as connection:
            self._renew(connection, job=job)

    def _renew(self, connection: sa.Connection, **values: Any) -> None:
        entry = {"host": socket.gethostname(), "device": self._device, "seen": clock(), "job": None} | values
        mine = workers.c.id == self._worker
        if connection.execute(workers.update().where(mine).values(entry)).rowcount == 0:
            connection.execute(workers.insert().values({"id": self._worker, "started": clock()} | entry))

    def unregister(self) -> None:
        """Delete the entry."""
        with write(self._engine) as connection:
            connection.execute(workers.delete().where(workers.c.id == self._worker))

    def reap(self, silence: float) -> list[str]:
        """Requeue the jobs of workers without a heartbeat for ``silence`` seconds. Returns the ids of the jobs."""
        gone = sa.or_(workers.c.id.is_(None), workers.c.seen < clock() - silence)
        orphans = sa.select(jobs).outerjoin(workers, jobs.c.worker == workers.c.id)
        orphans = orphans.where(jobs.c.state == JobState.running.value, gone)
        with self._engine.connect() as connection:
            if connection.execute(orphans.limit(1)).first() is None:
                return []
        with write(self._engine) as connection:
            rows = connection.execute(orphans.with_for_update(of=jobs, skip_locked=True)).all()
            for row in rows:
                lose(connection, row, f"{row.worker} sent no heartbeat for {silence:.0f} s")
            long_gone = workers.c.seen < clock() - max(FORGOTTEN, silence)
            connection.execute(workers.delete().where(long_gone))
            return [row.id for row in rows]
