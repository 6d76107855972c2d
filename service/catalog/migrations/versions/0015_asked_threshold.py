"""The threshold that a client asked for, beside the one that was used.

Both were one column, which the last step of a survey writes: run twice, it took the model's own for a client's, and
told tiles as changed in which no object lies.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; of surveys that are ready nobody knows any more who chose, and nothing depends on it."""
    with op.batch_alter_table("surveys") as batch:
        batch.add_column(sa.Column("asked_threshold", sa.Double()))
    surveys = sa.table(
        "surveys", sa.column("asked_threshold"), sa.column("threshold"), sa.column("status", sa.String())
    )
    op.execute(
        surveys.update().where(surveys.c.status != "ready").values(asked_threshold=surveys.c.threshold)
    )
