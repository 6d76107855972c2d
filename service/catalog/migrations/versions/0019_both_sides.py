"""The sighting that tells the other side of an object which moved, where its latest sighting tells one side alone.

The objects of every map are worked out anew where the catalog is opened next, for their kinds may be others now.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns, and leave the maps that have objects to be caught up with."""
    with op.batch_alter_table("map_objects") as batch:
        batch.add_column(sa.Column("other_survey_id", sa.String()))
        batch.add_column(sa.Column("other_number", sa.Integer()))
    op.execute(sa.text("UPDATE maps SET objects = NULL WHERE id IN (SELECT map_id FROM map_objects)"))
