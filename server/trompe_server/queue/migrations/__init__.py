"""Creation and upgrade of the tables, by Alembic. Each file in ``versions`` is one step."""

import logging
from pathlib import Path
from typing import Final

import sqlalchemy as sa

from trompe_server.errors import ServiceError
from trompe_server.queue.tables import metadata
from trompe_server.storage.database import write

__all__ = ["HEAD", "upgrade"]

HEAD: Final = "4"
"""The newest revision in ``versions``."""
_LOCK: Final = 0x74726F6D7065
"""Advisory lock of PostgreSQL: one process migrates at a time."""


def upgrade(engine: sa.Engine) -> None:
    """Bring the database to revision ``HEAD``. On SQLite also switch the file to WAL mode, permanently.

    Raises ``ServiceError`` for a database of version 0.1 or of a newer version, and for one that has lost tables.
    """
    if engine.dialect.name == "sqlite":
        with engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA journal_mode=WAL")
    with engine.connect() as connection:
        if _revision(connection) == HEAD:
            if missing := sorted(metadata.tables.keys() - set(sa.inspect(connection).get_table_names())):
                raise ServiceError(
                    f"{engine.url!r} lacks the tables {', '.join(missing)}: restore a backup, or choose another "
                    "--data or --database."
                )
            return
    with write(engine) as connection:
        if engine.dialect.name == "postgresql":
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK)))
        revision = _revision(connection)
        if revision is None and sa.inspect(connection).has_table("jobs"):
            raise ServiceError(
                f"{engine.url!r} was made by Trompe 0.1, which this version cannot read: choose another folder with "
                "--data (or another --database), or keep Trompe 0.1 for it."
            )
        if revision != HEAD:
            _migrate(connection)


def _revision(connection: sa.Connection) -> str | None:
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar_one_or_none()


def _migrate(connection: sa.Connection) -> None:
    """Run the missing steps in the transaction of ``connection``."""
    logging.getLogger("alembic").setLevel(logging.WARNING)
    from alembic import command  # here, because most starts find the tables up to date
    from alembic.config import Config
    from alembic.util import CommandError

    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    try:
        command.upgrade(config, "head")
    except CommandError as error:
        raise ServiceError(
            f"The tables in {connection.engine.url!r} were made by a newer Trompe ({error}); use that version, or "
            "another --data or --database."
        ) from error
