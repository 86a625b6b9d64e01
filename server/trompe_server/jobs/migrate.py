"""Makes the tables, once, before anything works with them."""

from collections.abc import Sequence
from typing import Final

import sqlalchemy as sa

from trompe_server import access
from trompe_server.database import write
from trompe_server.jobs.tables import LEASES, TOTALS, leases, metadata, totals

__all__ = ["migrate"]

_LOCK = 0x74726F6D7065
"""Keeps two processes that migrate the same PostgreSQL apart."""


def migrate(engine: sa.Engine) -> None:
    """Make the tables where they are missing. On SQLite put the file in WAL mode, which lasts."""
    if engine.dialect.name == "sqlite":
        with engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA journal_mode=WAL")
    with write(engine) as connection:
        if engine.dialect.name == "postgresql":
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK)))
        older = _put_aside(connection)
        metadata.create_all(connection)
        if older:
            connection.exec_driver_sql(_CARRY_OVER)
            connection.exec_driver_sql("DROP TABLE jobs_0")
        access.migrate(connection)
        _stock(connection, totals, TOTALS, value=0.0)
        _stock(connection, leases, LEASES, until=0.0)


def _put_aside(connection: sa.Connection) -> bool:
    """Rename the jobs of version 0.1, which another engine queued, on SQLite alone; whether there were any."""
    tables = sa.inspect(connection)
    if not tables.has_table("jobs") or any(column["name"] == "needs" for column in tables.get_columns("jobs")):
        return False
    connection.exec_driver_sql("DROP INDEX IF EXISTS ix_jobs_state")
    connection.exec_driver_sql("ALTER TABLE jobs RENAME TO jobs_0")
    return True


_CARRY_OVER: Final = """
INSERT INTO jobs (number, id, state, spec, object, classifier, priority, needs, labels, created, started, finished,
                  progress, done, attempts, lost, events, cancel_requested, error, note, artifacts)
SELECT number, id, CASE state WHEN 'running' THEN 'queued' ELSE state END, spec, json_extract(spec, '$.object'),
       json_extract(spec, '$.classifier'), 100, 'any', '{}', created, started, finished, progress, 0, attempts, lost,
       (SELECT max(id) FROM job_events WHERE job = jobs_0.id), cancel_requested, error, note, artifacts
FROM jobs_0
"""
"""What was running is queued again, and begins anew."""


def _stock(connection: sa.Connection, table: sa.Table, names: Sequence[str], **values: float) -> None:
    """Make the rows that are only ever updated."""
    known = set(connection.execute(sa.select(table.c.name)).scalars())
    for name in names:
        if name not in known:
            connection.execute(table.insert().values(name=name, **values))
