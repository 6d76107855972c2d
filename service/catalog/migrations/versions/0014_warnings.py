"""Scans and surveys carry what is odd about them: their clock at once, the rest once a worker has read the file."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column to both; of what was there nothing is known."""
    for table in ("scans", "surveys"):
        with op.batch_alter_table(table) as batch:
            batch.add_column(sa.Column("warnings", sa.JSON(none_as_null=True)))
