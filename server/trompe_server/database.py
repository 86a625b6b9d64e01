"""One database by URL, SQLite or PostgreSQL, with the same code on both.

SQLite is for one machine: WAL, and write transactions that take the lock at their beginning. PostgreSQL is for many:
rows are locked one by one, and a process that is frozen within a transaction loses its locks. Where the database cannot
be reached, everything that asks it raises ``DatabaseDownError``.
"""

import logging
import random
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, TypeVar

import sqlalchemy as sa
from sqlalchemy.engine.interfaces import ExceptionContext
from sqlalchemy.exc import ArgumentError, InterfaceError, NoSuchModuleError, OperationalError
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement

from trompe_server.errors import ServiceError

__all__ = ["DatabaseDownError", "clock", "connect", "patiently", "write"]

logger = logging.getLogger(__name__)

T = TypeVar("T")

BUSY_TIMEOUT: Final = 30_000
"""Milliseconds that a writer of SQLite waits for the one before it."""
POSTGRES: Final = {
    "connect_timeout": 5,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 15_000,
    "options": "-c statement_timeout=30000 -c lock_timeout=15000 -c idle_in_transaction_session_timeout=15000",
}
"""No call takes longer than half a minute, whatever becomes of the server; times without a name are milliseconds."""
PATIENCE: Final = (0.1, 2.0)
"""Shortest and longest wait before a call is repeated, seconds."""


class DatabaseDownError(ServiceError):
    """The database cannot be reached, or does not answer in time."""

    code = "database-down"


class clock(FunctionElement[float]):  # noqa: N801
    """Seconds since 1970 by the clock of the database: the one clock that all processes share."""

    type = sa.Float()
    inherit_cache = True


@compiles(clock, "sqlite")
def _sqlite_clock(_element: clock, _compiler: Any, **_: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(clock, "postgresql")
def _postgres_clock(_element: clock, _compiler: Any, **_: Any) -> str:
    return "CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS DOUBLE PRECISION)"


def connect(url: str) -> sa.Engine:
    """The database at ``url``: ``sqlite:///FILE`` or ``postgresql://USER:PASSWORD@HOST:PORT/NAME``.

    Nothing is asked of it yet. Raises ``ServiceError`` for a URL that is neither.
    """
    try:
        parsed = sa.make_url(url)
    except ArgumentError as error:
        raise ServiceError(_no_url(url)) from error
    kind = parsed.drivername.partition("+")[0]
    if kind == "sqlite" and parsed.database:
        engine = sa.create_engine(parsed, pool_size=20, max_overflow=30)
        sa.event.listen(engine, "connect", _prepare_sqlite)
    elif kind in {"postgresql", "postgres"}:
        engine = _postgres(parsed.set(drivername="postgresql+psycopg"))
    else:
        raise ServiceError(_no_url(url))
    sa.event.listen(engine, "handle_error", _say_that_it_is_down, retval=True)
    return engine


def _postgres(url: sa.URL) -> sa.Engine:
    try:
        return sa.create_engine(url, pool_pre_ping=True, pool_size=10, max_overflow=40, connect_args=POSTGRES)
    except (ImportError, NoSuchModuleError) as error:
        raise ServiceError("PostgreSQL needs psycopg: pip install 'trompe[server]'") from error


@contextmanager
def write(engine: sa.Engine) -> Iterator[sa.Connection]:
    """A transaction that writes. On SQLite it is alone from its beginning, so that what it read stays true; on
    PostgreSQL the rows that it reads ``with_for_update`` do.
    """
    with engine.begin() as connection:
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        yield connection


def patiently(action: Callable[[], T], *, stopped: Callable[[], bool] = lambda: False) -> T:
    """What ``action`` returns, repeated for as long as the database is down and nobody has ``stopped`` it.

    ``action`` must bear being done twice: an answer can be lost after the database has done what it was asked.
    """
    wait = PATIENCE[0]
    while True:
        try:
            return action()
        except DatabaseDownError as error:
            if stopped():
                raise
            logger.warning("%s Trying again.", error)
        time.sleep(wait * random.uniform(0.5, 1.0))
        wait = min(wait * 2, PATIENCE[1])


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = "IMMEDIATE"
    connection.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT}")
    connection.execute("PRAGMA synchronous=NORMAL")


def _say_that_it_is_down(context: ExceptionContext) -> BaseException | None:
    error = context.sqlalchemy_exception
    if context.is_pre_ping:
        return None  # a connection that was cut meanwhile is replaced
    if context.is_disconnect or isinstance(error, (OperationalError, InterfaceError)):
        words = str(context.original_exception).strip().splitlines() or [type(context.original_exception).__name__]
        return DatabaseDownError(f"The database cannot be used just now ({words[0]}).")
    return None


def _no_url(url: str) -> str:
    shown = re.sub(r"(://[^:/@]*:).*@", r"\1***@", url)
    return (
        f"{shown!r} names no database that can be used: give sqlite:////absolute/path.sqlite or "
        "postgresql://user:password@host:5432/name (--database or TROMPE_DATABASE)."
    )
