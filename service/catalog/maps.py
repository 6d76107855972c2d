"""Maps: asked for, built by a job, then compared with surveys."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, selectinload

from service.catalog import keys, tables
from service.catalog.blobs import Blobs
from service.catalog.clock import new_id, now
from service.catalog.database import Database
from service.catalog.jobs import job_record, new_job
from service.catalog.outcomes import checked_scan_ids, outcome, write_outcomes
from service.catalog.page import Page, Position, newest_first, page_of
from service.catalog.records import Bounds, JobRecord, MapRecord, Problem, ScanOutcome
from service.catalog.scans import rows_in_order
from service.errors import Conflict, NotFound, NotReady


class Maps:
    """The maps of the catalog."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database = database
        self._blobs = blobs

    def create(
        self,
        *,
        scan_ids: Sequence[str],
        model: str,
        map_id: str | None = None,
        name: str | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> tuple[MapRecord, JobRecord]:
        """Record a map and its job together. Raises NotFound (a scan), Conflict (the id), BadRequest (the scans)."""
        scan_ids = checked_scan_ids(scan_ids)
        map_id = map_id or new_id("map")
        job = new_job("map", map_id)
        row = tables.Map(
            id=map_id,
            name=name,
            status="building",
            model=model,
            settings=dict(settings or {}),
            counts={},
            job_id=job.id,
            created=job.created,
            updated=job.created,
            scans=[tables.MapScan(scan_id=scan_id, ordinal=n) for n, scan_id in enumerate(scan_ids)],
        )
        try:
            with self._database.write() as session:
                rows_in_order(session, scan_ids)
                session.add(row)
                session.flush()
                session.add(job)
                session.flush()
                return _record(row, None), job_record(job)
        except IntegrityError as error:
            raise Conflict(f"map {map_id!r} exists; choose another id or delete that map") from error

    def get(self, map_id: str) -> MapRecord:
        """One map. Raises NotFound."""
        with self._database.read() as session:
            return _read(session, map_id)

    def ready(self, map_id: str) -> MapRecord:
        """One map that is built. Raises NotFound and NotReady."""
        found = self.get(map_id)
        if found.status == "building":
            raise NotReady(f"map {map_id!r} is still building; follow job {found.job_id}")
        if found.status == "failed":
            raise NotReady(f"map {map_id!r} could not be built; job {found.job_id} says why")
        return found

    def page(self, *, after: Position | None = None, limit: int = 100) -> Page[MapRecord]:
        """Maps, newest first."""
        query = newest_first(
            select(tables.Map, tables.Job.problem)
            .outerjoin(tables.Job, tables.Job.id == tables.Map.job_id)
            .options(selectinload(tables.Map.scans)),
            tables.Map.created,
            tables.Map.id,
            after=after,
            limit=limit,
        )
        with self._database.read() as session:
            return page_of([_record(row, problem) for row, problem in session.execute(query)], limit)

    def save_outcomes(
        self, map_id: str, outcomes: Iterable[ScanOutcome], *, job_id: str | None = None
    ) -> None:
        """Record what became of the scans, also when the map then fails.

        Raises NotFound, also where another job than `job_id` builds the map of this id by now.
        """
        with self._database.write() as session:
            row = _row(session, map_id, job_id)
            write_outcomes(row.scans, outcomes)
            row.updated = now()

    def save_result(
        self,
        map_id: str,
        *,
        outcomes: Iterable[ScanOutcome],
        bounds: Bounds,
        counts: Mapping[str, int],
        job_id: str | None = None,
    ) -> None:
        """Record the built map, replacing an earlier run's result; `jobs.succeed` makes it ready.

        Raises NotFound, also where another job than `job_id` builds the map of this id by now.
        """
        with self._database.write() as session:
            row = _row(session, map_id, job_id)
            write_outcomes(row.scans, outcomes)
            row.bounds = bounds.model_dump(mode="json")
            row.counts = dict(counts)
            row.updated = now()

    def delete(self, map_id: str) -> None:
        """Forget a map with its surveys, jobs and files; the scans stay. Raises NotFound."""
        with self._database.write() as session:
            row = _row(session, map_id)
            surveys = session.scalars(select(tables.Survey.id).where(tables.Survey.map_id == map_id)).all()
            built_by = row.job_id
            session.delete(row)
        self._blobs.delete_prefix(keys.map_folder(built_by))
        for survey_id in surveys:
            self._blobs.delete_prefix(keys.survey_folder(survey_id))


def _row(session: Session, map_id: str, job_id: str | None = None) -> tables.Map:
    row = session.get(tables.Map, map_id)
    if row is None or job_id not in (None, row.job_id):
        raise NotFound(f"no map {map_id!r}; GET /maps lists those there are")
    return row


def _read(session: Session, map_id: str) -> MapRecord:
    row = _row(session, map_id)
    job = session.get(tables.Job, row.job_id)
    return _record(row, None if job is None else job.problem)


def _record(row: tables.Map, problem: dict[str, Any] | None) -> MapRecord:
    return MapRecord(
        map_id=row.id,
        name=row.name,
        status=row.status,
        model=row.model,
        settings=row.settings,
        scans=tuple(outcome(scan) for scan in row.scans),
        bounds=None if row.bounds is None else Bounds.model_validate(row.bounds),
        counts=row.counts,
        job_id=row.job_id,
        problem=None if problem is None else Problem.model_validate(problem),
        created=row.created,
        updated=row.updated,
    )
