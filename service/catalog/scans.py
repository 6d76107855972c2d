"""Scans: uploaded files, known by their content and the device they came from."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from uuid import uuid4

from sqlalchemy import ColumnElement, delete, exists, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.catalog import blob_keys, tables
from service.catalog.blobs import Blobs
from service.catalog.clock import now
from service.catalog.database import Database
from service.catalog.page import Page, Position, newest_first, page_of
from service.catalog.records import Matrix, ScanFormat, ScanRecord
from service.errors import Conflict, NotFound


def scan_id_of(sha256: str, device_id: str | None) -> str:
    """The id of these bytes from this device: the same upload twice is one scan."""
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
    ) -> tuple[ScanRecord, bool]:
        """Keep the file at `path` (moved when it can be) and say whether it is new.

        A scan that is known stays as it was recorded, but notes that it was sent again; `correct` changes it.
        """
        scan_id = scan_id_of(sha256, device_id)
        if known := self._sent_again(scan_id):
            return known, False
        key = blob_keys.scan_file(scan_id, uuid4().hex, filename)
        self._blobs.put_file(key, path, move=True)
        row = tables.Scan(
            id=scan_id,
            filename=filename,
            format=format,
            size=size,
            sha256=sha256,
            device_id=device_id,
            captured_at=captured_at,
            pose=None if pose is None else [list(line) for line in pose],
            key=key,
            created=now(),
        )
        try:
            with self._database.write() as session:
                session.add(row)
                session.flush()
                return _record(row), True
        except IntegrityError:  # the same upload, a moment earlier
            self._blobs.delete_prefix(blob_keys.folder_of(key))
            if known := self._sent_again(scan_id):
                return known, False
            raise Conflict(
                f"scan {scan_id!r} was deleted while it was sent again; send it once more"
            ) from None

    def correct(
        self, scan_id: str, *, captured_at: datetime | None = None, pose: Matrix | None = None
    ) -> ScanRecord:
        """Change what is said of a scan; what is None stays. Raises NotFound.

        Raises Conflict where it would change under a map or survey that rests on it.
        """
        with self._database.write() as session:
            row = session.get(tables.Scan, scan_id, with_for_update=True)
            if row is None:
                raise NotFound(f"no scan {scan_id!r}; upload it with POST /scans")
            known = _record(row)
            new_time = captured_at is not None and captured_at != known.captured_at
            new_pose = pose is not None and pose != known.pose
            if not (new_time or new_pose):
                return known
            if session.scalar(select(_in_use(scan_id))):
                what = " and ".join(["pose"] * new_pose + ["captured_at"] * new_time)
                raise Conflict(
                    f"scan {scan_id!r} has the same bytes, another {what}, and belongs to a map or survey; delete "
                    "what rests on it, then the scan, and send it again"
                )
            row.captured_at = captured_at or known.captured_at
            row.pose = row.pose if pose is None else [list(line) for line in pose]
            session.flush()
            return _record(row)

    def get(self, scan_id: str) -> ScanRecord:
        """One scan. Raises NotFound."""
        with self._database.read() as session:
            row = session.get(tables.Scan, scan_id)
            if row is None:
                raise NotFound(f"no scan {scan_id!r}; upload it with POST /scans")
            return _record(row)

    def many(self, scan_ids: Sequence[str]) -> tuple[ScanRecord, ...]:
        """Several scans, in the order asked for. Raises NotFound naming every id that is unknown."""
        with self._database.read() as session:
            return rows_in_order(session, scan_ids)

    def page(self, *, after: Position | None = None, limit: int = 100) -> Page[ScanRecord]:
        """Scans, newest first."""
        query = newest_first(
            select(tables.Scan), tables.Scan.created, tables.Scan.id, after=after, limit=limit
        )
        with self._database.read() as session:
            return page_of([_record(row) for row in session.scalars(query)], limit)

    def delete(self, scan_id: str) -> None:
        """Forget a scan and its file. Raises NotFound, and Conflict while a map or survey rests on it."""
        try:
            if not self._forget(tables.Scan.id == scan_id):
                raise NotFound(f"no scan {scan_id!r}")
        except IntegrityError as error:
            raise Conflict(f"scan {scan_id!r} belongs to a map or survey; delete that first") from error

    def take_back(self, added: ScanRecord) -> None:
        """Forget a scan that `add` said was new, unless somebody else sent it again or uses it by now."""
        with contextlib.suppress(IntegrityError):
            self._forget(tables.Scan.key == added.key, tables.Scan.resent.is_(None))

    def _forget(self, *which: ColumnElement[bool]) -> bool:
        """Delete one scan, then the very file that its row named: another of the same bytes may just be coming."""
        with self._database.write() as session:
            key = session.scalar(delete(tables.Scan).where(*which).returning(tables.Scan.key))
        if key is None:
            return False
        self._blobs.delete_prefix(blob_keys.folder_of(key))
        return True

    def _sent_again(self, scan_id: str) -> ScanRecord | None:
        """The scan of this id, with the note that one more client relies on it; None where there is none."""
        statement = update(tables.Scan).where(tables.Scan.id == scan_id).values(resent=now())
        with self._database.write() as session:
            row = session.scalar(statement.returning(tables.Scan))
            return None if row is None else _record(row)


def rows_in_order(session: Session, scan_ids: Sequence[str]) -> tuple[ScanRecord, ...]:
    """The scans of `scan_ids`, in that order. Raises NotFound naming every id that is unknown."""
    found = {row.id: row for row in session.scalars(select(tables.Scan).where(tables.Scan.id.in_(scan_ids)))}
    missing = [scan_id for scan_id in scan_ids if scan_id not in found]
    if missing:
        raise NotFound(f"no scan {', '.join(map(repr, missing))}; upload it with POST /scans")
    return tuple(_record(found[scan_id]) for scan_id in scan_ids)


def _in_use(scan_id: str) -> ColumnElement[bool]:
    return exists().where(tables.VersionScan.scan_id == scan_id) | exists().where(
        tables.SurveyScan.scan_id == scan_id
    )


def _record(row: tables.Scan) -> ScanRecord:
    return ScanRecord(
        scan_id=row.id,
        filename=row.filename,
        format=row.format,
        size=row.size,
        sha256=row.sha256,
        device_id=row.device_id,
        captured_at=row.captured_at,
        pose=row.pose,
        key=row.key,
        created=row.created,
    )
