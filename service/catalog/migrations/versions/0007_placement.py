"""Why a scan was left out as a value of a list with its numbers, and how sure the placement of a survey is.

Until now `reason` was a sentence: it becomes `detail`, and no reason of the list is guessed from it.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add columns to the scans of versions and surveys, and to surveys; move the sentences."""
    for table in ("version_scans", "survey_scans"):
        with op.batch_alter_table(table) as batch:
            batch.add_column(sa.Column("confidence", sa.Double()))
            batch.add_column(sa.Column("detail", sa.String()))
            for name in ("numbers", "candidates", "warnings"):
                batch.add_column(sa.Column(name, sa.JSON(none_as_null=True)))
        told = sa.table(table, sa.column("reason", sa.String()), sa.column("detail", sa.String()))
        sentences = told.update().where(told.c.reason.is_not(None))
        op.execute(sentences.values(detail=told.c.reason, reason=None))
    with op.batch_alter_table("surveys") as batch:
        batch.add_column(sa.Column("placement", sa.JSON(none_as_null=True)))
