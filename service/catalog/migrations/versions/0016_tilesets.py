"""Versions of maps and surveys say of their tileset how large it is; null: there is none."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column to both; what is there was built without one."""
    for table in ("map_versions", "surveys"):
        with op.batch_alter_table(table) as batch:
            batch.add_column(sa.Column("tileset", sa.JSON(none_as_null=True)))
