"""One dispatcher hands out the jobs: leases have holders, workers faults, jobs heartbeats and needs in amounts."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "3", "2"


def upgrade() -> None:
    """Change ``leases``, ``workers`` and the values of ``jobs.needs``."""
    op.add_column("leases", sa.Column("holder", sa.String, nullable=False, server_default=""))
    op.execute("INSERT INTO leases (name, until) VALUES ('dispatcher', 0)")
    op.execute("DELETE FROM workers")
    op.drop_column("workers", "job")
    op.add_column("workers", sa.Column("fault", sa.String))
    op.add_column("jobs", sa.Column("seen", sa.Double))
    jobs = sa.table("jobs", sa.column("needs"))
    op.execute(jobs.update().where(jobs.c.needs == "cuda").values(needs='{"gpu":1.0}'))
    op.execute(jobs.update().where(jobs.c.needs.in_(["any", "cpu"])).values(needs="{}"))
