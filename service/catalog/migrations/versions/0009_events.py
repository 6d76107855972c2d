"""Events; an id and a number of publication for changes of tiles, and a number for objects.

What is told by now is numbered in the order in which its surveys ended, as near as that is known. Of that there are no
events: the log begins behind it.
"""

from __future__ import annotations

from uuid import uuid4

import sqlalchemy as sa
from alembic import op

from service.catalog.sql.tables import UtcDateTime

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the tables of events, make that of changes anew, and number what was told so far."""
    op.create_table(
        "events",
        sa.Column("sequence", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("type", sa.String(), nullable=False),
        sa.Column("map_id", sa.String()),
        sa.Column("subject", sa.String(), nullable=False),
        sa.Column("data", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("created", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("sequence", name="pk_events"),
    )
    op.create_index("ix_events_map_id_sequence", "events", ["map_id", "sequence"])
    op.create_index("ix_events_created", "events", ["created"])
    op.create_table(
        "event_log",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("last", sa.BigInteger(), nullable=False),
        sa.Column("swept", sa.BigInteger(), nullable=False, server_default="0"),
        sa.PrimaryKeyConstraint("id", name="pk_event_log"),
    )
    with op.batch_alter_table("map_objects") as batch:
        batch.add_column(sa.Column("published", sa.BigInteger(), nullable=False, server_default="0"))
    op.create_index("ix_map_objects_map_id_published", "map_objects", ["map_id", "published"])
    numbered = _number_changes()
    numbered = _number_objects(numbered)
    if numbered:
        log = sa.table("event_log", *(sa.column(name) for name in ("id", "last", "swept")))
        op.bulk_insert(log, [{"id": 1, "last": numbered, "swept": numbered}])


def _number_changes() -> int:
    """Make the table of changes anew, with what it holds; returns the last number given."""
    connection = op.get_bind()
    told = connection.execute(
        sa.text(
            "SELECT surveys.map_id, tile_changes.* FROM tile_changes JOIN surveys ON surveys.id = tile_changes.survey_id "
            "ORDER BY surveys.updated, surveys.id, tile_changes.max_score DESC, tile_changes.tile_id"
        )
    ).mappings()
    rows = [{**row, "id": f"change-{uuid4().hex}", "published": number} for number, row in enumerate(told, 1)]
    op.drop_table("tile_changes")
    table = op.create_table(
        "tile_changes",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("map_id", sa.String(), nullable=False),
        sa.Column("survey_id", sa.String(), nullable=False),
        sa.Column("tile_id", sa.String(), nullable=False),
        sa.Column("first_seen", UtcDateTime(), nullable=False),
        sa.Column("last_seen", UtcDateTime(), nullable=False),
        sa.Column("max_score", sa.Double(), nullable=False),
        sa.Column("published", sa.BigInteger(), nullable=False, server_default="0"),
        sa.PrimaryKeyConstraint("id", name="pk_tile_changes"),
        sa.ForeignKeyConstraint(["map_id"], ["maps.id"], name="fk_tile_changes_map_id", ondelete="CASCADE"),
    )
    op.create_index("ix_tile_changes_survey_id_tile_id", "tile_changes", ["survey_id", "tile_id"])
    op.create_index("ix_tile_changes_map_id_published", "tile_changes", ["map_id", "published"])
    if rows:
        plain = sa.table("tile_changes", *(sa.column(column.name) for column in table.columns))
        connection.execute(plain.insert(), rows)
    return len(rows)


def _number_objects(numbered: int) -> int:
    """Number the objects behind the changes; returns the last number given."""
    connection = op.get_bind()
    ids = connection.execute(sa.text("SELECT id FROM map_objects ORDER BY created, id")).scalars().all()
    for number, object_id in enumerate(ids, numbered + 1):
        connection.execute(
            sa.text("UPDATE map_objects SET published = :number WHERE id = :id"),
            {"number": number, "id": object_id},
        )
    return numbered + len(ids)
