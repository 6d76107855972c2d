"""The name of the frame that the pose of a scan leads to."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; nobody said it of the scans that are there."""
    with op.batch_alter_table("scans") as batch:
        batch.add_column(sa.Column("frame", sa.String()))
