"""Models that a site trains on its own maps."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.catalog.tables import UtcDateTime

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """None so far."""
    op.create_table(
        "models",
        sa.Column("job_id", sa.String(), nullable=False),
        sa.Column("map_id", sa.String(), nullable=False),
        sa.Column("map_version", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("status", sa.String(), nullable=False),
        sa.Column("base", sa.String(), nullable=True),
        sa.Column("minutes", sa.Double(), nullable=False),
        sa.Column("epochs", sa.Integer(), nullable=True),
        sa.Column("card", sa.JSON(none_as_null=True), nullable=True),
        sa.Column("created", UtcDateTime(), nullable=False),
        sa.Column("updated", UtcDateTime(), nullable=False),
        sa.ForeignKeyConstraint(["map_id"], ["maps.id"], name=op.f("fk_models_map_id"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("job_id", name=op.f("pk_models")),
        sa.UniqueConstraint("name", "number", name=op.f("uq_models_name_number")),
    )
    op.create_index(op.f("ix_models_map_id"), "models", ["map_id"])
    op.add_column("jobs", sa.Column("model", sa.String(), nullable=True))


def downgrade() -> None:
    """The models are forgotten with their jobs, and their files stay behind."""
    op.execute("DELETE FROM jobs WHERE kind = 'model'")
    op.drop_column("jobs", "model")
    op.drop_table("models")
