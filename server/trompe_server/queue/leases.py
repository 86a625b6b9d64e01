"""Leases: work done by one process at a time, and the store of the one that dispatches the jobs."""

from typing import Final

import sqlalchemy as sa

from trompe_server.queue.tables import leases
from trompe_server.storage.database import clock, write
from trompe_server.storage.folders import Folder

DISPATCHER: Final = "dispatcher"
RETENTION: Final = "retention"
MARKS: Final = "dispatchers"
"""Folder in the store with a file for each dispatcher that uses it."""


def take_lease(engine: sa.Engine, name: str, *, holder: str, seconds: float) -> bool:
    """Take or renew the lease of the work ``name``; return whether ``holder`` has it for the next ``seconds``."""
    free = sa.and_(leases.c.name == name, sa.or_(leases.c.until < clock(), leases.c.holder == holder))
    taken = leases.update().where(free).values(until=clock() + seconds, holder=holder)
    with write(engine) as connection:
        return connection.execute(taken).rowcount == 1


def lease_holder(engine: sa.Engine, name: str) -> str | None:
    """Who has the lease of the work ``name`` now."""
    with engine.connect() as connection:
        return connection.scalar(sa.select(leases.c.holder).where(leases.c.name == name, leases.c.until > clock()))


def end_lease(engine: sa.Engine, name: str, *, holder: str) -> None:
    """End the lease of ``holder`` now, if it has it."""
    held = sa.and_(leases.c.name == name, leases.c.holder == holder)
    with write(engine) as connection:
        connection.execute(leases.update().where(held).values(until=0.0))


def mark_store(files: Folder, dispatcher: str) -> None:
    """Tell all who see the store ``files`` that ``dispatcher`` uses it."""
    files.within(MARKS).write(dispatcher, dispatcher.encode())


def shares_store(files: Folder, dispatcher: str) -> bool:
    """Whether ``files`` is the store of ``dispatcher``."""
    return files.within(MARKS).exists(dispatcher)
