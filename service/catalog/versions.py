"""Versions of a map: the first from its scans, each later one from the version in use and what came since."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from service.catalog import blob_keys, tables
from service.catalog.blobs import Blobs
from service.catalog.clock import now
from service.catalog.database import Database
from service.catalog.jobs import job_record, new_job
from service.catalog.outcomes import write_outcomes
from service.catalog.page import Page, Position, newest_first, page_of
from service.catalog.records import Bounds, JobRecord, ScanOutcome, VersionRecord
from service.catalog.version_rows import (
    check_deletable,
    check_ready,
    current_row,
    forget,
    further_scans,
    kept_scans,
    map_row,
    new_row,
    next_number,
    row_of_job,
    survey_scans,
    version_record,
    version_row,
)
from service.errors import BadRequest


class Versions:
    """The versions of the catalog's maps."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database = database
        self._blobs = blobs

    def create(
        self, map_id: str, *, scan_ids: Sequence[str] = (), survey_id: str | None = None
    ) -> tuple[VersionRecord, JobRecord]:
        """Record a version of further scans or of an accepted survey, and its job; the one in use is its base.

        Raises NotFound (map, survey, scan), NotReady (map, survey), BadRequest (the scans; both or neither of the two),
        Conflict (another version builds; the base has taken the survey over).
        """
        if bool(scan_ids) == (survey_id is not None):
            raise BadRequest(
                "a version is made either of scans (scan_ids or files) or of one survey (survey_id)"
            )
        with self._database.write() as session:
            of = map_row(session, map_id, lock=True)
            base = current_row(session, map_id)
            number = next_number(session, map_id)
            new = (
                further_scans(session, scan_ids, base)
                if survey_id is None
                else survey_scans(session, survey_id, base)
            )
            job = new_job("map", map_id)
            row = new_row(
                job,
                [*kept_scans(base), *new],
                number=number,
                base_version=base.number,
                survey_id=survey_id,
            )
            session.add_all([row, job])
            session.flush()
            return version_record(row, of, None), job_record(job)

    def get(self, map_id: str, number: int) -> VersionRecord:
        """One version. Raises NotFound."""
        with self._database.read() as session:
            return _read(session, version_row(session, map_id, number))

    def ready(self, map_id: str, number: int) -> VersionRecord:
        """One version that is built. Raises NotFound and NotReady."""
        found = self.get(map_id, number)
        check_ready(found.status, f"version {number} of map {map_id!r}", found.job_id)
        return found

    def of_job(self, job_id: str) -> VersionRecord:
        """The version that a job builds. Raises NotFound, also where it was deleted since."""
        with self._database.read() as session:
            return _read(session, row_of_job(session, job_id))

    def page(self, map_id: str, *, after: Position | None = None, limit: int = 100) -> Page[VersionRecord]:
        """Versions of a map, newest first. Raises NotFound."""
        query = newest_first(
            select(tables.MapVersion, tables.Job.problem)
            .outerjoin(tables.Job, tables.Job.id == tables.MapVersion.job_id)
            .where(tables.MapVersion.map_id == map_id)
            .options(selectinload(tables.MapVersion.scans)),
            tables.MapVersion.created,
            tables.MapVersion.job_id,
            after=after,
            limit=limit,
        )
        with self._database.read() as session:
            of = map_row(session, map_id)
            found = [version_record(row, of, problem) for row, problem in session.execute(query)]
        return page_of(found, limit)

    def save_outcomes(self, job_id: str, outcomes: Iterable[ScanOutcome]) -> None:
        """Record what became of the scans, also when the version then fails. Raises NotFound."""
        with self._database.write() as session:
            row = row_of_job(session, job_id)
            write_outcomes(row.scans, outcomes)
            row.updated = now()

    def save_result(
        self,
        job_id: str,
        *,
        outcomes: Iterable[ScanOutcome],
        bounds: Bounds,
        counts: Mapping[str, int],
        registration: Mapping[str, Any] | None = None,
    ) -> None:
        """Record what was built, replacing an earlier run's result; `jobs.succeed` makes it ready.

        Raises NotFound, also where the version was deleted since.
        """
        with self._database.write() as session:
            row = row_of_job(session, job_id)
            write_outcomes(row.scans, outcomes)
            row.bounds = bounds.model_dump(mode="json")
            row.counts = dict(counts)
            row.registration = None if registration is None else dict(registration)
            row.updated = now()

    def delete(self, map_id: str, number: int) -> None:
        """Forget a version with its job and files; surveys that were compared with it stay.

        Raises NotFound, and Conflict for the version in use, one that builds, and one that a survey still needs.
        """
        with self._database.write() as session:
            map_row(session, map_id, lock=True)
            row = version_row(session, map_id, number)
            check_deletable(session, row)
            built_by = row.job_id
            forget(session, row)
        self._blobs.delete_prefix(blob_keys.map_folder(built_by))

    def take_back(self, job_id: str) -> None:
        """Forget a version whose job never reached the queue."""
        with self._database.write() as session:
            forget(session, row_of_job(session, job_id))


def _read(session: Session, row: tables.MapVersion) -> VersionRecord:
    job = session.get(tables.Job, row.job_id)
    return version_record(row, map_row(session, row.map_id), None if job is None else job.problem)
