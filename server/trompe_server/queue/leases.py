"""Leases: periodic work done by one process at a time."""

from typing import Final

import sqlalchemy as sa

from trompe_server.queue.tables import leases
from trompe_server.storage.database import clock, write

__all__ = ["RETENTION", "take_lease"]

RETENTION: Final = "retention"


def take_lease(engine: sa.Engine, name: str, *, seconds: float) -> bool:
    """Return whether this process may do the work ``name`` now. No other process gets it for ``seconds``."""
    free = sa.and_(leases.c.name == name, leases.c.until < clock())
    with write(engine) as connection:
        return connection.execute(leases.update().where(free).values(until=clock() + seconds)).rowcount == 1
