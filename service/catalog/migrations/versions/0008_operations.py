"""Jobs know the step that is due; API keys; tallies for metrics.

Until now the queue alone knew how far a job was, and every job that ran is put at its first step: steps may run twice.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.catalog.sql.tables import UtcDateTime

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_FIRST_STEPS = {"map": "register", "survey": "register", "model": "pack"}


def upgrade() -> None:
    """Add columns to jobs, put each at its first step, and add the tables of keys and tallies."""
    with op.batch_alter_table("jobs") as batch:
        batch.add_column(sa.Column("step", sa.String(), nullable=False, server_default=""))
        batch.add_column(sa.Column("interruptions", sa.Integer(), nullable=False, server_default="0"))
        batch.add_column(sa.Column("due", UtcDateTime()))
        batch.add_column(sa.Column("begun", UtcDateTime()))
        batch.add_column(sa.Column("owner", sa.String()))
    jobs = sa.table("jobs", *(sa.column(name) for name in ("kind", "step", "due", "created", "status")))
    for kind, step in _FIRST_STEPS.items():
        op.execute(jobs.update().where(jobs.c.kind == kind).values(step=step, due=jobs.c.created))
    op.create_table(
        "keys",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("digest", sa.String(), nullable=False),
        sa.Column("scopes", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("maps", sa.JSON(none_as_null=True)),
        sa.Column("created", UtcDateTime(), nullable=False),
        sa.Column("expires", UtcDateTime()),
        sa.Column("revoked", UtcDateTime()),
        sa.PrimaryKeyConstraint("id", name="pk_keys"),
    )
    op.create_index("ix_keys_digest", "keys", ["digest"], unique=True)
    op.create_table(
        "tallies",
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("labels", sa.String(), nullable=False),
        sa.Column("count", sa.BigInteger(), nullable=False),
        sa.Column("total", sa.Double(), nullable=False),
        sa.PrimaryKeyConstraint("name", "labels", name="pk_tallies"),
    )
