"""Scans: uploaded files, known by their content and the device they came from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.catalog import keys, tables
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

        A scan that is known stays as it was first recorded: its id names its bytes, and maps rest on its pose.
        """
        scan_id = scan_id_of(sha256, device_id)
        with self._database.read() as session:
            known = session.get(tables.Scan, scan_id)
            if known is not None:
                return _record(known), False
        key = keys.scan_file(scan_id, filename)
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
            return self.get(scan_id), False

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
            with self._database.write() as session:
                row = session.get(tables.Scan, scan_id)
                if row is None:
                    raise NotFound(f"no scan {scan_id!r}")
                session.delete(row)
        except IntegrityError as error:
            raise Conflict(f"scan {scan_id!r} belongs to a map or survey; delete that first") from error
        self._blobs.delete_prefix(keys.scan_folder(scan_id))


def rows_in_order(session: Session, scan_ids: Sequence[str]) -> tuple[ScanRecord, ...]:
    """The scans of `scan_ids`, in that order. Raises NotFound naming every id that is unknown."""
    found = {row.id: row for row in session.scalars(select(tables.Scan).where(tables.Scan.id.in_(scan_ids)))}
    missing = [scan_id for scan_id in scan_ids if scan_id not in found]
    if missing:
        raise NotFound(f"no scan {', '.join(map(repr, missing))}; upload it with POST /scans")
    return tuple(_record(found[scan_id]) for scan_id in scan_ids)


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
