"""The database, SQLite or PostgreSQL, with the same code for both.

SQLite serves one machine: WAL, and write transactions that lock the whole database. PostgreSQL serves many machines:
it locks rows, and a process frozen within a transaction loses its locks. Every call raises ``DatabaseDownError`` if the
database cannot be reached, and ``SpecError`` for a value that it cannot hold.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.engine.interfaces import ExceptionContext
from sqlalchemy.exc import ArgumentError, DatabaseError, DataError, InterfaceError, InternalError, OperationalError
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement

from trompe_server.errors import ServiceError
from trompe_shared.addresses import without_password
from trompe_shared.errors import SpecError

NO_SUCH_TABLE, NO_RIGHT = "42P01", "42501"
"""PostgreSQL's codes (SQLSTATE) of statements that are right, in a database that is not."""

BUSY_TIMEOUT: Final = 30_000
"""Milliseconds a writer of SQLite waits for the writer before it."""
POSTGRES: Final = {
    "connect_timeout": 5,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 15_000,
    "options": "-c statement_timeout=30000 -c lock_timeout=15000 -c idle_in_transaction_session_timeout=15000",
}
"""No call takes longer than half a minute, whatever happens to the server. Timeouts in ``options`` are in ms."""


class DatabaseDownError(ServiceError):
    """The database cannot be reached or does not answer in time."""

    code = "database-down"


class clock(FunctionElement[float]):  # noqa: N801
    """Seconds since 1970 by the clock of the database, which all processes share."""

    type = sa.Float()
    inherit_cache = True


@compiles(clock, "sqlite")
def _sqlite_clock(_element: clock, _compiler: Any, **_: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(clock, "postgresql")
def _postgres_clock(_element: clock, _compiler: Any, **_: Any) -> str:
    return "CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS DOUBLE PRECISION)"


def connect(url: str) -> sa.Engine:
    """Engine for ``url``: ``sqlite:///FILE`` or ``postgresql://USER:PASSWORD@HOST:PORT/NAME``. Does not connect yet.

    Raises ``ServiceError`` for any other URL.
    """
    try:
        parsed = sa.make_url(url)
    except ArgumentError as error:
        raise ServiceError(_invalid_url(url)) from error
    kind = parsed.drivername.partition("+")[0]
    if kind == "sqlite" and parsed.database:
        engine = sa.create_engine(parsed, pool_size=20, max_overflow=30)
        sa.event.listen(engine, "connect", _prepare_sqlite)
    elif kind in {"postgresql", "postgres"}:
        parsed = parsed.set(drivername="postgresql+psycopg")
        password = parsed.query.get("password")
        if isinstance(password, str):  # messages show the query
            parsed = parsed.difference_update_query(["password"]).set(password=password)
        engine = sa.create_engine(parsed, pool_pre_ping=True, pool_size=10, max_overflow=40, connect_args=POSTGRES)
    else:
        raise ServiceError(_invalid_url(url))
    sa.event.listen(engine, "handle_error", _translate, retval=True)
    return engine


@contextmanager
def write(engine: sa.Engine) -> Iterator[sa.Connection]:
    """A write transaction. Locks the whole database on SQLite, the rows read ``with_for_update`` on PostgreSQL."""
    with engine.begin() as connection:
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        yield connection


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = "IMMEDIATE"
    connection.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT}")
    connection.execute("PRAGMA synchronous=NORMAL")


def _translate(context: ExceptionContext) -> BaseException | None:
    error = context.sqlalchemy_exception
    if context.is_pre_ping:
        return None  # the pool replaces a broken connection
    words = (str(context.original_exception).strip().splitlines() or [type(context.original_exception).__name__])[0]
    damaged = type(error) is DatabaseError  # SQLite's file; its subclasses mean other things
    closed = getattr(context.original_exception, "sqlstate", None) in {NO_SUCH_TABLE, NO_RIGHT}
    # PostgreSQL's InternalError: it only reads, as a standby or for want of space
    away = isinstance(error, (OperationalError, InterfaceError, InternalError))
    if damaged or closed or context.is_disconnect or away:
        return DatabaseDownError(f"The database is not available ({words}).")
    if isinstance(error, DataError):
        return SpecError(f"The database cannot hold such a value ({words}); use text without NUL characters.")
    return None


def _invalid_url(url: str) -> str:
    return (
        f"{without_password(url)!r} is not a supported database URL: give sqlite:////absolute/path.sqlite or "
        "postgresql://user:password@host:5432/name (--database or TROMPE_DATABASE)."
    )
