"""The tables of version 0.2."""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "1", None


def upgrade() -> None:
    number = sa.BigInteger().with_variant(sa.Integer, "sqlite")
    op.create_table(
        "jobs",
        sa.Column("number", number, primary_key=True, autoincrement=True),
        sa.Column("id", sa.String, unique=True, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("spec", sa.JSON, nullable=False),
        sa.Column("object", sa.String, nullable=False),
        sa.Column("classifier", sa.String, nullable=False),
        sa.Column("priority", sa.Integer, nullable=False),
        sa.Column("needs", sa.String, nullable=False),
        sa.Column("labels", sa.JSON, nullable=False),
        sa.Column("idempotency_key", sa.String, unique=True),
        sa.Column("worker", sa.String),
        sa.Column("created", sa.Double, nullable=False),
        sa.Column("started", sa.Double),
        sa.Column("finished", sa.Double),
        sa.Column("progress", sa.JSON, nullable=False),
        sa.Column("done", sa.Integer, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("lost", sa.Integer, nullable=False),
        sa.Column("events", sa.Integer, nullable=False),
        sa.Column("cancel_requested", sa.Boolean, nullable=False),
        sa.Column("error", sa.String),
        sa.Column("note", sa.String),
        sa.Column("artifacts", sa.JSON, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_index("jobs_by_state", "jobs", ["state", "number"])
    op.create_index("jobs_by_object", "jobs", ["object", "number"])
    op.create_index("jobs_by_classifier", "jobs", ["classifier", "number"])
    op.create_index("jobs_to_take", "jobs", ["state", "needs", "priority", "number"])
    op.create_index("jobs_by_end", "jobs", ["finished"])
    op.create_table(
        "job_labels",
        sa.Column("key", sa.String, primary_key=True),
        sa.Column("value", sa.String, primary_key=True),
        sa.Column("number", number, sa.ForeignKey("jobs.number", ondelete="CASCADE"), primary_key=True, index=True),
    )
    op.create_table(
        "job_events",
        sa.Column("job", sa.String, primary_key=True),
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("time", sa.Double, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("progress", sa.JSON, nullable=False),
        sa.Column("message", sa.String),
    )
    op.create_table(
        "workers",
        sa.Column("id", sa.String, primary_key=True),
        sa.Column("host", sa.String, nullable=False),
        sa.Column("device", sa.String, nullable=False),
        sa.Column("started", sa.Double, nullable=False),
        sa.Column("seen", sa.Double, nullable=False),
        sa.Column("job", sa.String),
    )
    leases = op.create_table(
        "leases", sa.Column("name", sa.String, primary_key=True), sa.Column("until", sa.Double, nullable=False)
    )
    op.bulk_insert(leases, [{"name": "retention", "until": 0.0}])
    op.create_table(
        "tokens",
        sa.Column("name", sa.String(63), primary_key=True),
        sa.Column("sha256", sa.String(64), unique=True, nullable=False),
        sa.Column("may", sa.String(5), nullable=False),
        sa.Column("created", sa.Double, nullable=False),
        sa.Column("last_used", sa.Double),
        sa.Column("revoked", sa.Double),
    )
