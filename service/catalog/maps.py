"""Maps: asked for, built by a job, version by version, and compared with surveys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import Select, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import selectinload

from service.catalog import blob_keys, tables
from service.catalog.blobs import Blobs
from service.catalog.clock import new_id, now
from service.catalog.database import Database
from service.catalog.jobs import job_record, new_job
from service.catalog.outcomes import checked_scan_ids
from service.catalog.page import Page, Position, newest_first, page_of
from service.catalog.records import Anchor, JobRecord, MapRecord, ScanOutcome
from service.catalog.scans import rows_in_order
from service.catalog.version_rows import check_ready, map_row, new_row, shown, version_record
from service.errors import Conflict, NotFound

_OF_VERSION_ALONE = frozenset({"base_version", "survey_id", "created", "updated"})


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
        anchor: Anchor | None = None,
    ) -> tuple[MapRecord, JobRecord]:
        """Record a map, its version 1 and the job of that together. Raises NotFound (a scan), Conflict (the id), BadRequest (the scans)."""
        scan_ids = checked_scan_ids(scan_ids)
        map_id = map_id or new_id("map")
        job = new_job("map", map_id)
        row = tables.Map(
            id=map_id,
            name=name,
            model=model,
            settings=dict(settings or {}),
            anchor=None if anchor is None else anchor.model_dump(),
            created=job.created,
            updated=job.created,
        )
        try:
            with self._database.write() as session:
                rows_in_order(session, scan_ids)
                session.add(row)
                session.flush()
                version = new_row(job, [ScanOutcome(scan_id=scan_id) for scan_id in scan_ids])
                session.add_all([version, job])
                session.flush()
                return _record(row, version, None), job_record(job)
        except IntegrityError as error:
            raise Conflict(f"map {map_id!r} exists; choose another id or delete that map") from error

    def get(self, map_id: str) -> MapRecord:
        """One map, as its version in use. Raises NotFound."""
        with self._database.read() as session:
            found = session.execute(_shown().where(tables.Map.id == map_id)).one_or_none()
            if found is None:
                raise NotFound(f"no map {map_id!r}; GET /maps lists those there are")
            return _record(*found)

    def ready(self, map_id: str) -> MapRecord:
        """One map that has a version to use. Raises NotFound and NotReady."""
        found = self.get(map_id)
        check_ready(found.status, f"map {map_id!r}", found.job_id)
        return found

    def page(self, *, after: Position | None = None, limit: int = 100) -> Page[MapRecord]:
        """Maps, newest first."""
        query = newest_first(_shown(), tables.Map.created, tables.Map.id, after=after, limit=limit)
        with self._database.read() as session:
            return page_of([_record(*found) for found in session.execute(query)], limit)

    def set_anchor(self, map_id: str, anchor: Anchor | None) -> MapRecord:
        """Say where the map lies on the Earth, or that nobody knows. Raises NotFound."""
        with self._database.write() as session:
            row = map_row(session, map_id)
            row.anchor = None if anchor is None else anchor.model_dump()
            row.updated = now()
        return self.get(map_id)

    def delete(self, map_id: str) -> None:
        """Forget a map with its versions, surveys, models, jobs and files; the scans stay. Raises NotFound."""
        versions = select(tables.MapVersion.job_id).where(tables.MapVersion.map_id == map_id)
        surveys = select(tables.Survey.id).where(tables.Survey.map_id == map_id)
        models = select(tables.Model.job_id).where(tables.Model.map_id == map_id)
        with self._database.write() as session:
            row = map_row(session, map_id, lock=True)
            folders = [blob_keys.map_folder(job_id) for job_id in session.scalars(versions)]
            folders += [blob_keys.survey_folder(survey_id) for survey_id in session.scalars(surveys)]
            folders += [blob_keys.model_folder(job_id) for job_id in session.scalars(models)]
            session.delete(row)
        for folder in folders:
            self._blobs.delete_prefix(folder)


def _shown() -> Select[Any]:
    """Maps, each with the version that it shows and with that one's problem."""
    return (
        select(tables.Map, tables.MapVersion, tables.Job.problem)
        .select_from(tables.Map)
        .join(tables.MapVersion, tables.MapVersion.job_id == shown())
        .outerjoin(tables.Job, tables.Job.id == tables.MapVersion.job_id)
        .options(selectinload(tables.MapVersion.scans))
    )


def _record(row: tables.Map, version: tables.MapVersion, problem: dict[str, Any] | None) -> MapRecord:
    found = version_record(version, row, problem)
    return MapRecord(
        name=row.name,
        anchor=None if row.anchor is None else Anchor.model_validate(row.anchor),
        created=row.created,
        updated=max(row.updated, version.updated),
        **{name: value for name, value in found if name not in _OF_VERSION_ALONE},
    )
