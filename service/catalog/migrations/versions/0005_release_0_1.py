"""The tables of release 0.1.

The revision keeps the number of the last of the five steps that led here, so that a database of the last 0.1 build is
up to date as it is; `database.upgrade` refuses one of an earlier step.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

from service.catalog.sql.tables import UtcDateTime

revision = "0005"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Make every table."""
    _make(
        "scans",
        ("id",),
        *_needed(sa.String(), "id filename format sha256 key"),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("device_id", sa.String()),
        sa.Column("captured_at", UtcDateTime()),
        _json("pose"),
        *_needed(UtcDateTime(), "created"),
        sa.Column("resent", UtcDateTime()),
    )
    _index("scans", "created", "id")
    _make(
        "maps",
        ("id",),
        *_needed(sa.String(), "id model"),
        sa.Column("name", sa.String()),
        _json("settings", nullable=False),
        _json("anchor"),
        *_needed(UtcDateTime(), "created updated"),
    )
    _index("maps", "created", "id")
    _make(
        "map_versions",
        ("job_id",),
        *_needed(sa.String(), "job_id map_id status"),
        *_needed(sa.Integer(), "number"),
        sa.Column("base_version", sa.Integer()),
        sa.Column("survey_id", sa.String()),
        _json("bounds"),
        _json("counts", nullable=False),
        _json("registration"),
        *_needed(UtcDateTime(), "created updated"),
        _foreign_key("map_versions", "map_id", "maps.id"),
        sa.UniqueConstraint("map_id", "number", name=op.f("uq_map_versions_map_id_number")),
    )
    _index("map_versions", "map_id", "created", "job_id")
    _make(
        "surveys",
        ("id",),
        *_needed(sa.String(), "id map_id status model job_id"),
        sa.Column("map_version", sa.Integer(), nullable=False, server_default="1"),
        sa.Column("threshold", sa.Double()),
        sa.Column("device_id", sa.String()),
        _json("counts", nullable=False),
        *_needed(UtcDateTime(), "captured_at created updated"),
        _foreign_key("surveys", "map_id", "maps.id"),
    )
    _index("surveys", "map_id", "captured_at", "id")
    _index("surveys", "map_id", "created", "id")
    _make(
        "survey_tiles",
        ("survey_id", "tile_id"),
        *_needed(sa.String(), "survey_id tile_id state"),
        *_needed(sa.Integer(), "i j k n_reference n_current"),
        *(sa.Column(name, sa.Double(), nullable=False) for name in _BOX),
        *(sa.Column(name, sa.Double()) for name in ("score", "p_unchanged", "p_changed", "p_different")),
        _foreign_key("survey_tiles", "survey_id", "surveys.id"),
    )
    _index("survey_tiles", "survey_id", "state", "score")
    _make_outcomes("version_scans", "job_id", "map_versions.job_id")
    _make_outcomes("survey_scans", "survey_id", "surveys.id")
    _make(
        "models",
        ("job_id",),
        *_needed(sa.String(), "job_id map_id name status"),
        *_needed(sa.Integer(), "map_version number"),
        sa.Column("base", sa.String()),
        sa.Column("minutes", sa.Double(), nullable=False),
        sa.Column("epochs", sa.Integer()),
        _json("card"),
        *_needed(UtcDateTime(), "created updated"),
        _foreign_key("models", "map_id", "maps.id"),
        sa.UniqueConstraint("name", "number", name=op.f("uq_models_name_number")),
    )
    _index("models", "map_id")
    _make(
        "jobs",
        ("id",),
        *_needed(sa.String(), "id kind map_id status message"),
        sa.Column("survey_id", sa.String()),
        sa.Column("model", sa.String()),
        *_needed(sa.Integer(), "progress"),
        _json("problem"),
        sa.Column("attempts", sa.Integer(), nullable=False, server_default="0"),
        *_needed(UtcDateTime(), "created updated"),
        sa.Column("started", UtcDateTime()),
        sa.Column("finished", UtcDateTime()),
        _foreign_key("jobs", "map_id", "maps.id"),
        _foreign_key("jobs", "survey_id", "surveys.id"),
    )
    _index("jobs", "created", "id")
    for column in ("map_id", "survey_id", "status"):
        _index("jobs", column)


_BOX = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")


def _make(table: str, key: tuple[str, ...], *parts: sa.Column[Any] | sa.Constraint) -> None:
    op.create_table(table, *parts, sa.PrimaryKeyConstraint(*key, name=op.f(f"pk_{table}")))


def _make_outcomes(table: str, owner: str, target: str) -> None:
    """Make the table of what became of each scan of a version or a survey."""
    _make(
        table,
        (owner, "scan_id"),
        *_needed(sa.String(), f"{owner} scan_id"),
        *_needed(sa.Integer(), "ordinal"),
        sa.Column("accepted", sa.Boolean()),
        *(
            sa.Column(name, sa.Double())
            for name in ("fitness", "rmse", "translation_sigma", "rotation_sigma")
        ),
        _json("map_from_scan"),
        _json("path"),
        sa.Column("reason", sa.String()),
        _foreign_key(table, owner, target),
        _foreign_key(table, "scan_id", "scans.id", cascade=False),
    )
    _index(table, "scan_id")


def _needed(kind: sa.types.TypeEngine[Any], names: str) -> list[sa.Column[Any]]:
    """Return columns of one type that are never NULL."""
    return [sa.Column(name, kind, nullable=False) for name in names.split()]


def _json(name: str, *, nullable: bool = True) -> sa.Column[Any]:
    return sa.Column(name, sa.JSON(none_as_null=True), nullable=nullable)


def _foreign_key(table: str, column: str, target: str, *, cascade: bool = True) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_{table}_{column}")
    return sa.ForeignKeyConstraint([column], [target], name=name, ondelete="CASCADE" if cascade else None)


def _index(table: str, *columns: str) -> None:
    op.create_index(op.f(f"ix_{table}_{'_'.join(columns)}"), table, list(columns))
