"""The scans of a map or survey: asked for first, then with what registration made of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

from service.catalog import tables
from service.catalog.records import ScanOutcome
from service.errors import BadRequest

Row = TypeVar("Row", tables.MapScan, tables.SurveyScan)


def outcome(row: tables.MapScan | tables.SurveyScan) -> ScanOutcome:
    """The record of a row."""
    return ScanOutcome(
        scan_id=row.scan_id,
        accepted=row.accepted,
        fitness=row.fitness,
        rmse=row.rmse,
        map_from_scan=row.map_from_scan,
        reason=row.reason,
    )


def write_outcomes(rows: Iterable[Row], outcomes: Iterable[ScanOutcome]) -> None:
    """Put `outcomes` on the rows of the same scans. Raises ValueError for a scan that was not asked for."""
    by_scan = {row.scan_id: row for row in rows}
    for found in outcomes:
        if found.scan_id not in by_scan:
            raise ValueError(f"scan {found.scan_id!r} does not belong to this map or survey")
        row = by_scan[found.scan_id]
        row.accepted, row.fitness, row.rmse = found.accepted, found.fitness, found.rmse
        row.reason = found.reason
        matrix = found.map_from_scan
        row.map_from_scan = None if matrix is None else [list(line) for line in matrix]


def checked_scan_ids(scan_ids: Sequence[str]) -> tuple[str, ...]:
    """At least one scan, none twice. Raises BadRequest."""
    if not scan_ids:
        raise BadRequest("no scans: name them in scan_ids or send files in scans")
    twice = sorted({scan_id for scan_id in scan_ids if scan_ids.count(scan_id) > 1})
    if twice:
        raise BadRequest(f"scan {', '.join(map(repr, twice))} is named more than once; name each scan once")
    return tuple(scan_ids)
