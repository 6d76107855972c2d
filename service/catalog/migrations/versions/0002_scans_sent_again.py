"""When a scan that was known was last sent again."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.catalog.tables import UtcDateTime

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; no scan was."""
    op.add_column("scans", sa.Column("resent", UtcDateTime(), nullable=True))


def downgrade() -> None:
    """Drop the column."""
    op.drop_column("scans", "resent")
