"""Versions of maps, the geo-anchor, and how certain each registration is."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

from service.catalog.tables import UtcDateTime

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_JSON = sa.JSON(none_as_null=True)
_OF_SCANS = "scan_id, ordinal, accepted, fitness, rmse, map_from_scan, reason"
#: The version that a map shows: the newest that is ready, else the newest.
_SHOWN = """
    SELECT v.job_id FROM map_versions v WHERE v.map_id = maps.id
    ORDER BY CASE WHEN v.status = 'ready' THEN 0 ELSE 1 END, v.number DESC LIMIT 1
"""


def upgrade() -> None:
    """Each map becomes version 1 of itself, and its surveys are of that version."""
    _make_versions()
    op.execute(
        "INSERT INTO map_versions (job_id, map_id, number, status, bounds, counts, created, updated) "
        "SELECT job_id, id, 1, status, bounds, counts, created, updated FROM maps"
    )
    _make_version_scans()
    op.execute(
        f"INSERT INTO version_scans (job_id, {_OF_SCANS}) SELECT maps.job_id, {_OF_SCANS} "
        "FROM map_scans JOIN maps ON maps.id = map_scans.map_id"
    )
    op.drop_table("map_scans")
    # Column by column: to copy the table, as batch mode does, would drop the old one and cascade to the surveys.
    for name in ("status", "bounds", "counts", "job_id"):
        op.drop_column("maps", name)
    op.add_column("maps", sa.Column("anchor", _JSON, nullable=True))
    op.add_column("surveys", sa.Column("map_version", sa.Integer(), nullable=False, server_default="1"))
    for column in _certainty():
        op.add_column("survey_scans", column)


def downgrade() -> None:
    """Each map keeps the version that it shows; the others are forgotten, and their files stay behind."""
    op.add_column("maps", sa.Column("status", sa.String(), nullable=False, server_default="failed"))
    op.add_column("maps", sa.Column("bounds", _JSON, nullable=True))
    op.add_column("maps", sa.Column("counts", _JSON, nullable=False, server_default="{}"))
    op.add_column("maps", sa.Column("job_id", sa.String(), nullable=False, server_default=""))
    op.execute(f"UPDATE maps SET job_id = ({_SHOWN})")
    for name in ("status", "bounds", "counts"):
        op.execute(
            f"UPDATE maps SET {name} = (SELECT v.{name} FROM map_versions v WHERE v.job_id = maps.job_id)"
        )
    _make_map_scans()
    op.execute(
        f"INSERT INTO map_scans (map_id, {_OF_SCANS}) SELECT maps.id, {_OF_SCANS} "
        "FROM version_scans JOIN maps ON maps.job_id = version_scans.job_id"
    )
    op.drop_table("version_scans")
    op.drop_table("map_versions")
    op.drop_column("maps", "anchor")
    op.drop_column("surveys", "map_version")
    for column in _certainty():
        op.drop_column("survey_scans", column.name)


def _certainty() -> tuple[sa.Column[Any], ...]:
    return (
        sa.Column("translation_sigma", sa.Double(), nullable=True),
        sa.Column("rotation_sigma", sa.Double(), nullable=True),
        sa.Column("path", _JSON, nullable=True),
    )


def _outcome() -> tuple[sa.Column[Any], ...]:
    return (
        sa.Column("scan_id", sa.String(), nullable=False),
        sa.Column("ordinal", sa.Integer(), nullable=False),
        sa.Column("accepted", sa.Boolean(), nullable=True),
        sa.Column("fitness", sa.Double(), nullable=True),
        sa.Column("rmse", sa.Double(), nullable=True),
        sa.Column("map_from_scan", _JSON, nullable=True),
        sa.Column("reason", sa.String(), nullable=True),
    )


def _make_versions() -> None:
    op.create_table(
        "map_versions",
        sa.Column("job_id", sa.String(), nullable=False),
        sa.Column("map_id", sa.String(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("status", sa.String(), nullable=False),
        sa.Column("base_version", sa.Integer(), nullable=True),
        sa.Column("survey_id", sa.String(), nullable=True),
        sa.Column("bounds", _JSON, nullable=True),
        sa.Column("counts", _JSON, nullable=False),
        sa.Column("registration", _JSON, nullable=True),
        sa.Column("created", UtcDateTime(), nullable=False),
        sa.Column("updated", UtcDateTime(), nullable=False),
        sa.ForeignKeyConstraint(
            ["map_id"], ["maps.id"], name=op.f("fk_map_versions_map_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("job_id", name=op.f("pk_map_versions")),
        sa.UniqueConstraint("map_id", "number", name=op.f("uq_map_versions_map_id_number")),
    )
    op.create_index(
        op.f("ix_map_versions_map_id_created_job_id"), "map_versions", ["map_id", "created", "job_id"]
    )


def _make_version_scans() -> None:
    op.create_table(
        "version_scans",
        sa.Column("job_id", sa.String(), nullable=False),
        *_outcome(),
        *_certainty(),
        sa.ForeignKeyConstraint(
            ["job_id"], ["map_versions.job_id"], name=op.f("fk_version_scans_job_id"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["scan_id"], ["scans.id"], name=op.f("fk_version_scans_scan_id")),
        sa.PrimaryKeyConstraint("job_id", "scan_id", name=op.f("pk_version_scans")),
    )
    op.create_index(op.f("ix_version_scans_scan_id"), "version_scans", ["scan_id"])


def _make_map_scans() -> None:
    """As 0001 has it."""
    op.create_table(
        "map_scans",
        sa.Column("map_id", sa.String(), nullable=False),
        *_outcome(),
        sa.ForeignKeyConstraint(
            ["map_id"], ["maps.id"], name=op.f("fk_map_scans_map_id"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["scan_id"], ["scans.id"], name=op.f("fk_map_scans_scan_id")),
        sa.PrimaryKeyConstraint("map_id", "scan_id", name=op.f("pk_map_scans")),
    )
    op.create_index(op.f("ix_map_scans_scan_id"), "map_scans", ["scan_id"])
