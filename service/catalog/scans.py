"""Scans: uploaded files, known by their content and their device, and what became of them in maps and surveys."""

from __future__ import annotations

import contextlib
import hashlib
import logging
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from sqlalchemy import ColumnElement, delete, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.following.publication import tell
from service.catalog.records import (
    Matrix,
    Page,
    Position,
    ScanFormat,
    ScanOutcome,
    ScanReason,
    ScanRecord,
    ScanWarning,
)
from service.catalog.sql import tables
from service.catalog.sql.clock import clock_warnings
from service.catalog.sql.database import Database
from service.errors import BadRequest, Conflict, DiskFull, NotFound

log = logging.getLogger(__name__)

#: Warnings that a file bears into every map and survey; the others are of one registration.
OF_THE_FILE: frozenset[ScanReason] = frozenset(
    (
        "far_from_origin",
        "far_points",
        "offset_taken_off",
        "no_sensor_place",
        "missing_returns",
        "odd_density",
        "odd_size",
        "little_coverage",
        "other_up_axis",
    )
)

NO_POSES: Mapping[str, Matrix] = {}
Row = TypeVar("Row", tables.VersionScan, tables.SurveyScan)


def scan_id_of(sha256: str, device_id: str | None) -> str:
    """Return the id of these bytes from this device: the same upload twice is one scan."""
    digest = hashlib.sha256(f"{sha256}\n{device_id or ''}".encode()).hexdigest()
    return f"scan-{digest[:32]}"


class Scans:
    """The scans of the catalog."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database = database
        self._blobs = blobs

    def add(
        self,
        path: Path,
        *,
        filename: str,
        format: ScanFormat,
        size: int,
        sha256: str,
        device_id: str | None = None,
        captured_at: datetime | None = None,
        pose: Matrix | None = None,
        frame: str | None = None,
    ) -> tuple[ScanRecord, bool]:
        """Keep the file at `path` (moved when it can be) and say whether it is new.

        A scan that is known stays as it was recorded, but notes that it was sent again; `correct` changes it. Where its
        file was lost the new one takes its place.
        """
        scan_id = scan_id_of(sha256, device_id)
        if known := self._sent_again(scan_id):
            self._mend(known, path)
            return known, False
        key = blob_keys.scan_file(scan_id, uuid4().hex, filename)
        self._blobs.put_file(key, path, move=True)
        received = tables.now()
        row = tables.Scan(
            scan_id=scan_id,
            filename=filename,
            format=format,
            size=size,
            sha256=sha256,
            device_id=device_id,
            captured_at=captured_at,
            pose=None if pose is None else [list(line) for line in pose],
            frame=frame,
            key=key,
            warnings=as_kept(clock_warnings(captured_at, received=received)),
            created=received,
        )
        return self._insert(row)

    def correct(
        self,
        scan_id: str,
        *,
        captured_at: datetime | None = None,
        pose: Matrix | None = None,
        frame: str | None = None,
    ) -> ScanRecord:
        """Change what is said of a scan; what is None stays. Raises NotFound.

        Maps and surveys that were asked for before keep the pose and the time that they were asked for with.
        """
        with self._database.write() as session:
            row = _row(session, scan_id, lock=True)
            if captured_at is not None and captured_at != row.captured_at:
                others = tuple(one for one in ScanRecord.of_row(row).warnings if one.reason != "clock")
                row.captured_at = captured_at
                row.warnings = as_kept((*clock_warnings(captured_at, received=tables.now()), *others))
            row.pose = row.pose if pose is None else [list(line) for line in pose]
            row.frame = frame or row.frame
            session.flush()
            return ScanRecord.of_row(row)

    def get(self, scan_id: str) -> ScanRecord:
        """Return one scan. Raises NotFound."""
        with self._database.read() as session:
            return ScanRecord.of_row(_row(session, scan_id))

    def page(self, *, after: Position | None = None, limit: int = 100) -> Page[ScanRecord]:
        """Return scans, newest first."""
        table = tables.Scan
        return self._database.page(
            select(table), table.created, table.scan_id, ScanRecord.of_row, after=after, limit=limit
        )

    def delete(self, scan_id: str) -> None:
        """Delete a scan and its file. Raises NotFound, and Conflict while a map or survey rests on it."""
        try:
            if not self._forget(tables.Scan.scan_id == scan_id):
                raise NotFound(f"no scan {scan_id!r}")
        except IntegrityError as error:
            raise Conflict(f"scan {scan_id!r} belongs to a map or survey; delete that first") from error

    def take_back(self, added: ScanRecord) -> None:
        """Delete a scan that `add` said was new, unless somebody else sent it again or uses it by now."""
        with contextlib.suppress(IntegrityError):
            self._forget(tables.Scan.key == added.key, tables.Scan.resent.is_(None))

    def forget(self, scan_id: str, condition: ColumnElement[bool]) -> bool:
        """Delete a scan with its file if a condition on its row holds; False where not, or where something uses it."""
        try:
            return self._forget(tables.Scan.scan_id == scan_id, condition)
        except IntegrityError:
            return False

    def _insert(self, row: tables.Scan) -> tuple[ScanRecord, bool]:
        """Record a scan whose file is kept, unless the same upload came a moment earlier. Raises Conflict, DiskFull."""
        scan_id, key = row.scan_id, row.key
        try:
            with self._database.write() as session:
                session.add(row)
                session.flush()
                tell(session, "scan.uploaded", scan_id, scan_id=scan_id, device_id=row.device_id)
                return ScanRecord.of_row(row), True
        except DiskFull:  # which says for sure that no row was kept, as a lost connection does not
            self._blobs.delete_prefix(blob_keys.folder_of(key))
            raise
        except IntegrityError:
            self._blobs.delete_prefix(blob_keys.folder_of(key))
            if known := self._sent_again(scan_id):
                return known, False
            raise Conflict(
                f"scan {scan_id!r} was deleted while it was sent again; send it once more"
            ) from None

    def _forget(self, *which: ColumnElement[bool]) -> bool:
        """Delete one scan, then the very file that its row named: another of the same bytes may just be coming."""
        with self._database.write() as session:
            columns = (tables.Scan.scan_id, tables.Scan.device_id, tables.Scan.key)
            gone = session.execute(delete(tables.Scan).where(*which).returning(*columns)).one_or_none()
            if gone is None:
                return False
            tell(session, "scan.deleted", gone.scan_id, scan_id=gone.scan_id, device_id=gone.device_id)
        self._blobs.delete_prefix(blob_keys.folder_of(gone.key))
        return True

    def _sent_again(self, scan_id: str) -> ScanRecord | None:
        """Return the scan of this id, with the note that one more client relies on it; None where there is none."""
        statement = update(tables.Scan).where(tables.Scan.scan_id == scan_id).values(resent=tables.now())
        with self._database.write() as session:
            row = session.scalar(statement.returning(tables.Scan))
            return None if row is None else ScanRecord.of_row(row)

    def _mend(self, known: ScanRecord, path: Path) -> None:
        """Put the same bytes, sent again, where those of a scan are gone or cut short."""
        with contextlib.suppress(FileNotFoundError):
            if self._blobs.size(known.key) == known.size:
                return
        log.warning("the file of scan %s was lost; it was sent again and is kept now", known.scan_id)
        self._blobs.put_file(known.key, path, move=True)


def checked_scan_ids(scan_ids: Sequence[str]) -> tuple[str, ...]:
    """Return the ids: at least one, none twice. Raises BadRequest."""
    if not scan_ids:
        raise BadRequest("no scans: name them in scan_ids or send files in scans")
    twice = sorted({scan_id for scan_id in scan_ids if scan_ids.count(scan_id) > 1})
    if twice:
        raise BadRequest(f"scan {', '.join(map(repr, twice))} is named more than once; name each scan once")
    return tuple(scan_ids)


def scans_in_order(session: Session, scan_ids: Sequence[str]) -> tuple[ScanRecord, ...]:
    """Return the scans of `scan_ids`, in that order. Raises NotFound naming every id that is unknown."""
    rows = session.scalars(select(tables.Scan).where(tables.Scan.scan_id.in_(scan_ids)))
    known = {row.scan_id: ScanRecord.of_row(row) for row in rows}
    missing = [scan_id for scan_id in scan_ids if scan_id not in known]
    if missing:
        raise NotFound(f"no scan {', '.join(map(repr, missing))}; upload it with POST /scans")
    return tuple(known[scan_id] for scan_id in scan_ids)


def new_uses(scans: Iterable[ScanRecord], poses: Mapping[str, Matrix]) -> tuple[ScanOutcome, ...]:
    """Return what a map or survey says of scans that are still to be registered.

    A pose is of this use: that in `poses`, by the id of the scan, else that of the upload as it is now.
    """
    return tuple(ScanOutcome(scan_id=scan.scan_id, pose=poses.get(scan.scan_id, scan.pose)) for scan in scans)


def put_in_place(
    kind: type[Row], rows: list[Row], scan_id: str, parts: Mapping[str, Matrix | None], *, keep: bool
) -> None:
    """Put scans, with their poses by id, in the place of the one that they were taken out of; `rows` are all of one use.

    `keep` leaves that one behind them, as of a file of which not all can be read. Does nothing where that is not among the
    rows, as when it was done already; a scan that is among them stays as it is.
    """
    old = next((row for row in rows if row.scan_id == scan_id), None)
    if old is None:
        return
    known = {row.scan_id for row in rows}
    uses = [ScanOutcome(scan_id=part, pose=pose) for part, pose in parts.items() if part not in known]
    for row in rows:
        row.ordinal += len(uses) if row.ordinal > old.ordinal else 0
    place = old.ordinal
    if keep:
        old.ordinal += len(uses)
    else:
        rows.remove(old)
    new = [kind(scan_id=use.scan_id, ordinal=place + n, **outcome_columns(use)) for n, use in enumerate(uses)]
    rows.extend(new)


def outcome_columns(outcome: ScanOutcome) -> dict[str, Any]:
    """Return the columns of an outcome, less its scan."""
    return outcome.model_dump(mode="json", exclude={"scan_id"})


def known_outcomes(rows: Iterable[Row]) -> list[str]:
    """Return the ids of the scans of which it is known what became of them."""
    return [row.scan_id for row in rows if row.accepted is not None]


def write_outcomes(session: Session, rows: Iterable[Row], outcomes: Iterable[ScanOutcome]) -> None:
    """Put `outcomes` on the rows of the same scans, and what they tell of the files on the scans.

    The rows keep the pose that they were asked for with.

    Raises ValueError for a scan that was not asked for.
    """
    by_scan = {row.scan_id: row for row in rows}
    scans = session.scalars(select(tables.Scan).where(tables.Scan.scan_id.in_(by_scan)))
    files = {row.scan_id: row for row in scans}
    for outcome in outcomes:
        if outcome.scan_id not in by_scan:
            raise ValueError(f"scan {outcome.scan_id!r} does not belong to this map or survey")
        columns = outcome_columns(_with_clock(outcome, files[outcome.scan_id]))
        del columns["pose"]
        for name, value in columns.items():
            setattr(by_scan[outcome.scan_id], name, value)


def _with_clock(outcome: ScanOutcome, row: tables.Scan) -> ScanOutcome:
    """Return an outcome with what is odd about the scan's clock; keeps on the scan what is odd about its file."""
    if outcome.accepted is None:
        return outcome
    clock = tuple(one for one in ScanRecord.of_row(row).warnings if one.reason == "clock")
    told = tuple(one for one in outcome.warnings if one.reason != "clock")
    row.warnings = as_kept((*clock, *(one for one in told if one.reason in OF_THE_FILE)))
    return outcome.model_copy(update={"warnings": (*clock, *told)})


def as_kept(warnings: Iterable[ScanWarning]) -> list[dict[str, Any]] | None:
    """Return warnings as a row keeps them; None of none."""
    return [one.model_dump(mode="json") for one in warnings] or None


def _row(session: Session, scan_id: str, *, lock: bool = False) -> tables.Scan:
    row = session.get(tables.Scan, scan_id, with_for_update=lock)
    if row is None:
        raise NotFound(f"no scan {scan_id!r}; upload it with POST /scans")
    return row
