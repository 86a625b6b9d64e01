"""Record of the attack workers, as the dispatcher sees them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

import sqlalchemy as sa

from trompe_server.queue.tables import workers
from trompe_server.storage.database import clock, write

FORGOTTEN: Final = 86_400.0
"""Seconds after which a worker that was not seen again is deleted."""


@dataclass(frozen=True)
class Worker:
    """A place where attempts run: a process of one machine, or a node of a cluster.

    ``device`` says what it has, ``fault`` why no attempt can run there.
    """

    id: str
    host: str
    device: str
    fault: str | None = None


def record_workers(engine: sa.Engine, living: Sequence[Worker]) -> None:
    with write(engine) as connection:
        for worker in living:
            entry = asdict(worker) | {"seen": clock()}
            if not connection.execute(workers.update().where(workers.c.id == worker.id).values(entry)).rowcount:
                connection.execute(workers.insert().values(entry | {"started": clock()}))
        connection.execute(workers.delete().where(workers.c.seen < clock() - FORGOTTEN))


def forget_workers(engine: sa.Engine) -> None:
    """Delete all workers: their dispatcher stops."""
    with write(engine) as connection:
        connection.execute(workers.delete())
