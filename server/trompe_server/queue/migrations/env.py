"""Alembic runs this file: it applies the missing steps to the connection given by ``upgrade``."""

from alembic import context

context.configure(connection=context.config.attributes["connection"])
with context.begin_transaction():
    context.run_migrations()
