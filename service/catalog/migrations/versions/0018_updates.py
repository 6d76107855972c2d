"""The number under which a change or an object that was told before was told anew, for what is known of it changed.

What is there by now was told as it is: it has no such number.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0016"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column, and an index to read in its order."""
    for table in ("tile_changes", "map_objects"):
        with op.batch_alter_table(table) as batch:
            batch.add_column(sa.Column("updated", sa.BigInteger(), nullable=False, server_default="0"))
        op.create_index(f"ix_{table}_map_id_updated", table, ["map_id", "updated"])
