"""Attempts lost together with their dispatcher are counted by themselves."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "4", "3"


def upgrade() -> None:
    op.add_column("jobs", sa.Column("orphaned", sa.Integer, nullable=False, server_default="0"))
