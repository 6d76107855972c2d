"""The scans of a map or survey: asked for first, then with what registration made of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

from service.catalog import tables
from service.catalog.records import ScanOutcome
from service.errors import BadRequest

Row = TypeVar("Row", tables.VersionScan, tables.SurveyScan)

_FACTS = tuple(name for name in ScanOutcome.model_fields if name != "scan_id")  #: columns of the same names


def outcome(row: tables.VersionScan | tables.SurveyScan) -> ScanOutcome:
    """The record of a row."""
    return ScanOutcome(scan_id=row.scan_id, **{name: getattr(row, name) for name in _FACTS})


def facts(found: ScanOutcome) -> dict[str, Any]:
    """The columns of an outcome, less its scan."""
    return found.model_dump(mode="json", exclude={"scan_id"})


def write_outcomes(rows: Iterable[Row], outcomes: Iterable[ScanOutcome]) -> None:
    """Put `outcomes` on the rows of the same scans. Raises ValueError for a scan that was not asked for."""
    by_scan = {row.scan_id: row for row in rows}
    for found in outcomes:
        if found.scan_id not in by_scan:
            raise ValueError(f"scan {found.scan_id!r} does not belong to this map or survey")
        for name, value in facts(found).items():
            setattr(by_scan[found.scan_id], name, value)


def checked_scan_ids(scan_ids: Sequence[str]) -> tuple[str, ...]:
    """At least one scan, none twice. Raises BadRequest."""
    if not scan_ids:
        raise BadRequest("no scans: name them in scan_ids or send files in scans")
    twice = sorted({scan_id for scan_id in scan_ids if scan_ids.count(scan_id) > 1})
    if twice:
        raise BadRequest(f"scan {', '.join(map(repr, twice))} is named more than once; name each scan once")
    return tuple(scan_ids)
