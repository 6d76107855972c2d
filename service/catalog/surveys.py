"""Surveys: a later visit, registered to a map and compared with it by a job."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any, get_args

from sqlalchemy import delete, select
from sqlalchemy.orm import Session, selectinload

from service.catalog import blob_keys, tables
from service.catalog.blobs import Blobs
from service.catalog.clock import new_id, now
from service.catalog.database import Database
from service.catalog.jobs import job_record, new_job
from service.catalog.outcomes import checked_scan_ids, outcome, write_outcomes
from service.catalog.page import Page, Position, newest_first, page_of
from service.catalog.records import JobRecord, Problem, ScanOutcome, SurveyRecord, TileRecord, TileState
from service.catalog.scans import rows_in_order
from service.catalog.tiles import tile_row
from service.catalog.version_rows import current_row, map_row
from service.errors import Conflict, NotFound, NotReady


class Surveys:
    """The surveys of the catalog."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database = database
        self._blobs = blobs

    def create(
        self,
        map_id: str,
        *,
        scan_ids: Sequence[str],
        model: str,
        threshold: float | None = None,
        device_id: str | None = None,
        captured_at: datetime | None = None,
    ) -> tuple[SurveyRecord, JobRecord]:
        """Record a survey and its job together. Raises NotFound, NotReady (the map), BadRequest (the scans)."""
        scan_ids = checked_scan_ids(scan_ids)
        survey_id = new_id("survey")
        job = new_job("survey", map_id, survey_id)
        with self._database.write() as session:
            map_row(session, map_id, lock=True)  # nobody deletes the version meanwhile
            version = current_row(session, map_id)
            scans = rows_in_order(session, scan_ids)
            taken = [scan.captured_at for scan in scans if scan.captured_at is not None]
            row = tables.Survey(
                id=survey_id,
                map_id=map_id,
                map_version=version.number,
                status="running",
                model=model,
                threshold=threshold,
                device_id=device_id,
                captured_at=captured_at or max(taken, default=job.created),
                counts={},
                job_id=job.id,
                created=job.created,
                updated=job.created,
                scans=[tables.SurveyScan(scan_id=scan_id, ordinal=n) for n, scan_id in enumerate(scan_ids)],
            )
            session.add(row)
            session.flush()
            session.add(job)
            session.flush()
            return _record(row, None), job_record(job)

    def get(self, survey_id: str) -> SurveyRecord:
        """One survey. Raises NotFound."""
        with self._database.read() as session:
            row = _row(session, survey_id)
            job = session.get(tables.Job, row.job_id)
            return _record(row, None if job is None else job.problem)

    def ready(self, survey_id: str) -> SurveyRecord:
        """One survey that is done. Raises NotFound and NotReady."""
        found = self.get(survey_id)
        if found.status == "running":
            raise NotReady(f"survey {survey_id!r} is still running; follow job {found.job_id}")
        if found.status == "failed":
            raise NotReady(f"survey {survey_id!r} has no result; job {found.job_id} says why")
        return found

    def page(self, map_id: str, *, after: Position | None = None, limit: int = 100) -> Page[SurveyRecord]:
        """Surveys of a map, newest first."""
        query = newest_first(
            select(tables.Survey, tables.Job.problem)
            .outerjoin(tables.Job, tables.Job.id == tables.Survey.job_id)
            .where(tables.Survey.map_id == map_id)
            .options(selectinload(tables.Survey.scans)),
            tables.Survey.created,
            tables.Survey.id,
            after=after,
            limit=limit,
        )
        with self._database.read() as session:
            return page_of([_record(row, problem) for row, problem in session.execute(query)], limit)

    def save_outcomes(self, survey_id: str, outcomes: Iterable[ScanOutcome]) -> None:
        """Record what became of the scans, also when the survey then fails. Raises NotFound."""
        with self._database.write() as session:
            row = _row(session, survey_id)
            write_outcomes(row.scans, outcomes)
            row.updated = now()

    def save_result(
        self,
        survey_id: str,
        *,
        tiles: Iterable[TileRecord],
        threshold: float,
        counts: Mapping[str, int] | None = None,
    ) -> None:
        """Record the tiles, replacing those of an earlier run; `jobs.succeed` makes the survey ready.

        `threshold` is the one that was used. The number of tiles in each state is counted here; `counts` adds
        to it. Raises NotFound.
        """
        tiles = tuple(tiles)
        by_state = Counter(tile.state for tile in tiles)
        with self._database.write() as session:
            row = _row(session, survey_id)
            session.execute(delete(tables.SurveyTile).where(tables.SurveyTile.survey_id == survey_id))
            session.add_all(tile_row(survey_id, tile) for tile in tiles)
            row.threshold = threshold
            row.counts = {
                **(counts or {}),
                "tiles": len(tiles),
                **{state: by_state[state] for state in get_args(TileState)},
            }
            row.updated = now()

    def delete(self, survey_id: str) -> None:
        """Forget a survey with its job and files; the scans stay. Raises NotFound, and Conflict while a version is built of it."""
        with self._database.write() as session:
            row = _row(session, survey_id, lock=True)
            _check_unused(session, row)
            session.delete(row)
        self._blobs.delete_prefix(blob_keys.survey_folder(survey_id))


def _check_unused(session: Session, row: tables.Survey) -> None:
    """Raises Conflict while a version of the map is being built of the survey."""
    version = tables.MapVersion
    query = select(version).where(version.map_id == row.map_id, version.survey_id == row.id)
    built = session.scalar(query.where(version.status == "building"))
    if built is not None:
        raise Conflict(
            f"version {built.number} of map {row.map_id!r} is being built of survey {row.id!r}; wait for job "
            f"{built.job_id}, or dismiss it"
        )


def _row(session: Session, survey_id: str, *, lock: bool = False) -> tables.Survey:
    row = session.get(tables.Survey, survey_id, with_for_update=lock)
    if row is None:
        raise NotFound(f"no survey {survey_id!r}; GET /maps/<id>/surveys lists those there are")
    return row


def _record(row: tables.Survey, problem: dict[str, Any] | None) -> SurveyRecord:
    return SurveyRecord(
        survey_id=row.id,
        map_id=row.map_id,
        map_version=row.map_version,
        status=row.status,
        model=row.model,
        threshold=row.threshold,
        device_id=row.device_id,
        captured_at=row.captured_at,
        scans=tuple(outcome(scan) for scan in row.scans),
        counts=row.counts,
        job_id=row.job_id,
        problem=None if problem is None else Problem.model_validate(problem),
        created=row.created,
        updated=row.updated,
    )
