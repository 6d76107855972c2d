"""Maps: asked for, built by a job, version by version, and compared with surveys."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.following.publication import tell
from service.catalog.idempotency import ANY_TIMES, Once
from service.catalog.jobs import new_job
from service.catalog.records import (
    Anchor,
    Built,
    BuiltSummary,
    JobRecord,
    MapRecord,
    MapSummary,
    Matrix,
    Page,
    Position,
)
from service.catalog.scans import NO_POSES, checked_scan_ids, new_uses, scans_in_order
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.sql.tables import new_id, now
from service.catalog.versions import (
    check_ready,
    in_use,
    map_row,
    new_version,
    parts_of,
    shown_in_short,
    versions_in_short,
)
from service.errors import Conflict


class Maps:
    """The maps of the catalog."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database = database
        self._blobs = blobs

    def create(
        self,
        *,
        scan_ids: Sequence[str],
        poses: Mapping[str, Matrix] = NO_POSES,
        model: str,
        map_id: str | None = None,
        name: str | None = None,
        settings: Mapping[str, Any] | None = None,
        anchor: Anchor | None = None,
        once: Once = ANY_TIMES,
    ) -> tuple[MapRecord, JobRecord]:
        """Record a map, its version 1 and the job of that together; `poses` of scans, by id, count for this map alone.

        Raises NotFound (a scan), Conflict (the id), BadRequest (the scans), and what `once` does.
        """
        scan_ids = checked_scan_ids(scan_ids)
        map_id = map_id or new_id("map")
        job = new_job("map", map_id)
        row = tables.Map(
            map_id=map_id,
            name=name,
            model=model,
            settings=dict(settings or {}),
            anchor=None if anchor is None else anchor.model_dump(),
            objects={},
            created=job.created,
            updated=job.created,
        )
        try:
            with self._database.write() as session:
                once.claim(session)
                uses = new_uses(scans_in_order(session, scan_ids), poses)
                session.add(row)
                session.flush()
                version = new_version(job, uses, 1)
                session.add_all([version, job])
                session.flush()
                made = _record(version), JobRecord.of_row(job)
                once.keep(session, *made, job=job)
                return made
        except IntegrityError as error:
            raise Conflict(f"map {map_id!r} exists; choose another id or delete that map") from error

    def get(self, map_id: str, *, scans: int | None = None) -> MapRecord:
        """Return one map, as its version in use, with its first `scans` scans; left out: with all. Raises NotFound."""
        with self._database.read() as session:
            shown = shown_in_short(session, map_id)
            return MapRecord(**dict(_summary(shown)) | parts_of(session, shown, scans))

    def summary(self, map_id: str) -> MapSummary:
        """Return one map in short, whatever its number of scans. Raises NotFound."""
        with self._database.read() as session:
            return _summary(shown_in_short(session, map_id))

    def ready(self, map_id: str) -> MapSummary:
        """Return one map that has a version to use, in short. Raises NotFound and NotReady."""
        record = self.summary(map_id)
        check_ready(record.status, f"map {map_id!r}", record.job_id)
        return record

    def page(
        self, *, only: Collection[str] | None = None, after: Position | None = None, limit: int = 100
    ) -> Page[MapSummary]:
        """Return maps, newest first; `only` those of these ids where that is given."""
        created, key = tables.Map.created, tables.Map.map_id
        query = in_use(versions_in_short())
        query = query if only is None else query.where(key.in_(only))
        return self._database.page(query, created, key, _summary, after=after, limit=limit)

    def set_anchor(self, map_id: str, anchor: Anchor | None) -> MapRecord:
        """Say where the map lies on the Earth, or that nobody knows. Raises NotFound."""
        with self._database.write() as session:
            row = map_row(session, map_id)
            row.anchor = None if anchor is None else anchor.model_dump()
            row.updated = now()
        return self.get(map_id)

    def delete(self, map_id: str) -> None:
        """Delete a map with its versions, surveys, models, jobs and files; the scans stay. Raises NotFound."""
        versions = select(tables.MapVersion.job_id).where(tables.MapVersion.map_id == map_id)
        surveys = select(tables.Survey.survey_id).where(tables.Survey.map_id == map_id)
        models = select(tables.Model.job_id).where(tables.Model.map_id == map_id)
        with self._database.write() as session:
            row = map_row(session, map_id, lock=True)
            folders = [blob_keys.map_folder(job_id) for job_id in session.scalars(versions)]
            folders += [blob_keys.survey_folder(survey_id) for survey_id in session.scalars(surveys)]
            folders += [blob_keys.model_folder(job_id) for job_id in session.scalars(models)]
            session.delete(row)
            tell(session, "map.deleted", map_id, map_id=map_id)
        for folder in folders:
            self._blobs.delete_prefix(folder)


def _record(shown: tables.MapVersion) -> MapRecord:
    """Return the record of the map that shows this version."""
    return MapRecord(**dict(Built.of_row(shown)) | _of_map(shown))


def _summary(shown: tables.MapVersion) -> MapSummary:
    """Return the same in short."""
    return MapSummary(**dict(BuiltSummary.of_row(shown)) | _of_map(shown))


def _of_map(shown: tables.MapVersion) -> dict[str, Any]:
    """Return what a map says for itself, whichever version it shows."""
    row = shown.of_map
    own = {"name": row.name, "anchor": row.anchor, "objects": row.objects or {}}
    return own | {"created": row.created, "updated": max(row.updated, shown.updated)}
