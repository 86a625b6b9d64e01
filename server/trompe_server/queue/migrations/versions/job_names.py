"""Names of the stored things of a job."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "2", "1"


def upgrade() -> None:
    """Add the column ``names``, empty for older jobs."""
    op.add_column("jobs", sa.Column("names", sa.JSON, nullable=False, server_default="{}"))
