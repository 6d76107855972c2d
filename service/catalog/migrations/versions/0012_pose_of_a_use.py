"""A pose belongs to the use of a scan in a version or a survey.

Until now it was that of the upload, which could not change while anything rested on it: so that is what each use had.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column to both tables of uses, and give each the pose of its upload."""
    scans = sa.table("scans", sa.column("id"), sa.column("pose"))
    for name in ("version_scans", "survey_scans"):
        with op.batch_alter_table(name) as batch:
            batch.add_column(sa.Column("pose", sa.JSON(none_as_null=True)))
        uses = sa.table(name, sa.column("scan_id"), sa.column("pose"))
        pose = sa.select(scans.c.pose).where(scans.c.id == uses.c.scan_id).scalar_subquery()
        op.execute(uses.update().values(pose=pose))
