"""Objects of surveys and of maps, what a tile could judge, and tile changes told once.

Surveys of before keep their tiles, without shares or objects. What is derived over all surveys of a map is computed
where the catalog is opened next, for a map whose `objects` is NULL.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

from service.catalog.sql.tables import UtcDateTime

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_BOX = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")


def upgrade() -> None:
    """Add columns to maps, surveys and tiles, and four tables; remember what versions took over of surveys."""
    _add("maps", _json("objects"))
    _add("surveys", _json("objects"), sa.Column("moving", sa.Integer()))
    _add(
        "survey_tiles",
        sa.Column("observed_share", sa.Double()),
        sa.Column("appeared", sa.Integer()),
        sa.Column("disappeared", sa.Integer()),
        sa.Column("told_by", sa.String()),
    )
    _make(
        "tile_changes",
        ("survey_id", "tile_id"),
        *_needed(sa.String(), "survey_id tile_id"),
        *_needed(UtcDateTime(), "first_seen last_seen"),
        *_needed(sa.Double(), "max_score"),
        _foreign_key("tile_changes", "survey_id", "surveys.id"),
    )
    _make(
        "survey_objects",
        ("survey_id", "number"),
        *_needed(sa.String(), "survey_id kind"),
        *_needed(sa.Integer(), "number scans_seen_through"),
        *(_json(name) for name in ("now", "before", "motion")),
        *_needed(sa.Double(), "probability observed_share"),
        sa.Column("object_id", sa.String()),
        _foreign_key("survey_objects", "survey_id", "surveys.id"),
    )
    _index("survey_objects", "object_id")
    _make(
        "map_objects",
        ("id",),
        *_needed(sa.String(), "id map_id kind status last_known survey_id"),
        *_needed(sa.Boolean(), "transient"),
        *_needed(UtcDateTime(), "first_seen last_seen last_looked created"),
        sa.Column("accepted_in_version", sa.Integer()),
        *_needed(sa.Integer(), "sightings number"),
        *_needed(sa.Double(), f"probability {' '.join(_BOX)}"),
        _foreign_key("map_objects", "map_id", "maps.id"),
    )
    _index("map_objects", "map_id", "first_seen", "id")
    _make(
        "acceptances",
        ("map_id", "number"),
        *_needed(sa.String(), "map_id"),
        *_needed(sa.Integer(), "number"),
        _json("tiles", nullable=False),
        _json("objects", nullable=False),
        _foreign_key("acceptances", "map_id", "maps.id"),
    )
    _remember_acceptances()


def _remember_acceptances() -> None:
    """Write what the versions that are there took over, as far as their surveys are still there."""
    connection = op.get_bind()
    versions = connection.execute(
        sa.text(
            "SELECT map_id, number, survey_id FROM map_versions WHERE survey_id IS NOT NULL AND status = 'ready'"
        )
    )
    rows = []
    for map_id, number, survey_id in versions.all():
        query = sa.text(
            "SELECT tile_id FROM survey_tiles WHERE survey_id = :survey AND state = 'changed' ORDER BY tile_id"
        )
        tiles = list(connection.execute(query, {"survey": survey_id}).scalars())
        rows.append({"map_id": map_id, "number": number, "tiles": tiles, "objects": []})
    if rows:
        table = sa.table(
            "acceptances",
            sa.column("map_id", sa.String()),
            sa.column("number", sa.Integer()),
            sa.column("tiles", sa.JSON()),
            sa.column("objects", sa.JSON()),
        )
        op.bulk_insert(table, rows)


def _add(table: str, *columns: sa.Column[Any]) -> None:
    with op.batch_alter_table(table) as batch:
        for column in columns:
            batch.add_column(column)


def _make(table: str, key: tuple[str, ...], *parts: sa.Column[Any] | sa.Constraint) -> None:
    op.create_table(table, *parts, sa.PrimaryKeyConstraint(*key, name=op.f(f"pk_{table}")))


def _needed(kind: sa.types.TypeEngine[Any], names: str) -> list[sa.Column[Any]]:
    """Return columns of one type that are never NULL."""
    return [sa.Column(name, kind, nullable=False) for name in names.split()]


def _json(name: str, *, nullable: bool = True) -> sa.Column[Any]:
    return sa.Column(name, sa.JSON(none_as_null=True), nullable=nullable)


def _foreign_key(table: str, column: str, target: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_{table}_{column}")
    return sa.ForeignKeyConstraint([column], [target], name=name, ondelete="CASCADE")


def _index(table: str, *columns: str) -> None:
    op.create_index(op.f(f"ix_{table}_{'_'.join(columns)}"), table, list(columns))
