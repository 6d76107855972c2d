"""Surveys: a later visit, registered to a map and compared with it by a job."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import get_args

from sqlalchemy import delete, select
from sqlalchemy.orm import Session, selectinload, undefer

from service.catalog import tallies
from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.findings import history
from service.catalog.following.publication import tell
from service.catalog.idempotency import ANY_TIMES, Once
from service.catalog.jobs import new_job
from service.catalog.records import (
    JobRecord,
    Matrix,
    ObjectKind,
    ObjectRecord,
    Page,
    Placement,
    Position,
    ScanOutcome,
    SurveyRecord,
    SurveySummary,
    TileRecord,
    Tileset,
    TileState,
)
from service.catalog.scans import (
    NO_POSES,
    as_kept,
    checked_scan_ids,
    known_outcomes,
    new_uses,
    outcome_columns,
    put_in_place,
    scans_in_order,
    write_outcomes,
)
from service.catalog.sql import tables
from service.catalog.sql.clock import clock_warnings
from service.catalog.sql.database import Database
from service.catalog.sql.tables import Survey, SurveyObject, SurveyTile, new_id, now
from service.catalog.versions import map_row, tileset_of, version_in_use
from service.errors import Conflict, Failed, NotFound, NotReady


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
        poses: Mapping[str, Matrix] = NO_POSES,
        model: str,
        threshold: float | None = None,
        device_id: str | None = None,
        captured_at: datetime | None = None,
        owner: str | None = None,
        once: Once = ANY_TIMES,
    ) -> tuple[SurveyRecord, JobRecord]:
        """Record a survey and its job together; `owner` takes turns with others, left out it is the device.

        `poses` of scans, by id, count for this survey alone.

        Raises NotFound, NotReady (the map), BadRequest (the scans), and what `once` does.
        """
        scan_ids = checked_scan_ids(scan_ids)
        survey_id = new_id("survey")
        job = new_job("survey", map_id, survey_id, owner=owner or device_id)
        with self._database.write() as session:
            once.claim(session)
            map_row(session, map_id, lock=True)  # nobody deletes the version meanwhile
            version = version_in_use(session, map_id)
            scans = scans_in_order(session, scan_ids)
            taken = [scan.captured_at for scan in scans if scan.captured_at is not None]
            row = Survey(
                survey_id=survey_id,
                map_id=map_id,
                map_version=version.version,
                status="running",
                model=model,
                asked_threshold=threshold,
                threshold=threshold,
                device_id=device_id,
                captured_at=captured_at or max(taken, default=job.created),
                warnings=as_kept(clock_warnings(captured_at, received=job.created)),
                counts={},
                job_id=job.job_id,
                created=job.created,
                updated=job.created,
                scans=[
                    tables.SurveyScan(scan_id=use.scan_id, ordinal=n, **outcome_columns(use))
                    for n, use in enumerate(new_uses(scans, poses))
                ],
            )
            session.add(row)
            session.flush()
            session.add(job)
            session.flush()
            made = SurveyRecord.of_row(row), JobRecord.of_row(job)
            once.keep(session, *made, job=job)
            return made

    def get(self, survey_id: str) -> SurveyRecord:
        """Return one survey. Raises NotFound."""
        with self._database.read() as session:
            return SurveyRecord.of_row(_row(session, survey_id))

    def ready(self, survey_id: str) -> SurveyRecord:
        """Return one survey that is done. Raises NotFound, and NotReady or Failed."""
        survey = self.get(survey_id)
        _check_ready(survey.status, survey_id, survey.job_id)
        return survey

    def tileset(self, survey_id: str) -> Tileset:
        """Return the tileset of a survey that is done; of the scans nothing is read.

        Raises NotFound, also for a survey without a tileset, and NotReady.
        """
        with self._database.read() as session:
            row = _row(session, survey_id)
            _check_ready(row.status, survey_id, row.job_id)
            return tileset_of(row.tileset, f"survey {survey_id!r}")

    def page(self, map_id: str, *, after: Position | None = None, limit: int = 100) -> Page[SurveySummary]:
        """Return surveys of a map, newest first."""
        query = select(Survey).where(Survey.map_id == map_id)
        query = query.options(
            undefer(Survey.scan_count), undefer(Survey.accepted_count), selectinload(Survey.job)
        )
        created, key = Survey.created, Survey.survey_id
        return self._database.page(query, created, key, SurveySummary.of_row, after=after, limit=limit)

    def take_apart(
        self, key: str, scan_id: str, parts: Mapping[str, Matrix | None], *, keep: bool = False
    ) -> None:
        """Put the scans that one of the survey's was taken apart into in its place, with their poses.

        `keep` leaves that one behind them: it has more, which cannot be read. `key` is the id of the survey. Raises NotFound.
        """
        with self._database.write() as session:
            row = _row(session, key)
            put_in_place(tables.SurveyScan, row.scans, scan_id, parts, keep=keep)
            row.updated = now()

    def save_outcomes(
        self, survey_id: str, outcomes: Iterable[ScanOutcome], *, placement: Placement | None = None
    ) -> None:
        """Record what became of the scans, also when the survey then fails. Raises NotFound.

        `placement` is None where nobody judged it.
        """
        outcomes = tuple(outcomes)
        with self._database.write() as session:
            row = _row(session, survey_id)
            tallies.tally_outcomes(session, "survey", outcomes, known_outcomes(row.scans))
            write_outcomes(session, row.scans, outcomes)
            row.placement = None if placement is None else placement.model_dump()
            row.updated = now()

    def save_result(
        self,
        survey_id: str,
        *,
        tiles: Iterable[TileRecord],
        threshold: float,
        objects: Iterable[ObjectRecord] | None = None,
        moving: int | None = None,
        tileset: Tileset | None = None,
    ) -> None:
        """Record tiles and objects, replacing those of an earlier run; `jobs.succeed` makes the survey ready.

        `threshold` is the one that was used. `objects` is None where the detector tells tiles alone; such a survey has
        no say in what became of the objects of the map. `moving` counts what moved while the visit lasted. Tiles by
        state and objects by kind are counted here. Raises NotFound, and ValueError for a number that is given twice, and
        for an unchanged or changed tile or an object of a survey whose placement is in doubt.
        """
        tiles, things = tuple(tiles), tuple(objects or ())
        _check_numbers(things)
        told = bool(things) or (
            objects is not None and any(tile.observed_share is not None for tile in tiles)
        )
        by_state = Counter(tile.state for tile in tiles)
        by_kind = Counter(thing.kind for thing in things)
        with self._database.write() as session:
            row = _locked(session, survey_id)
            _check_doubt(row, by_state, told=told)
            if not row.counts:  # the first run of the step that tells them
                tallies.tally_tiles(session, row.model, tiles)
            _replace_tiles(session, survey_id, tiles)
            _replace_objects(session, survey_id, things)
            row.threshold = threshold
            row.counts = {"tiles": len(tiles), **{state: by_state[state] for state in get_args(TileState)}}
            row.objects = {kind: by_kind[kind] for kind in get_args(ObjectKind)} if told else None
            row.moving = moving
            row.tileset = None if tileset is None else tileset.model_dump()
            row.updated = now()
            if row.status == "ready":  # a step that was thought lost runs beside its second run, and is late
                history.rewrite(session, row.map_id)

    def delete(self, survey_id: str) -> None:
        """Delete a survey with its job and files; the scans stay.

        Raises NotFound, and Conflict while a version is built of it.
        """
        with self._database.write() as session:
            row = _locked(session, survey_id)
            _check_unused(session, row)
            session.delete(row)
            tell(session, "survey.deleted", survey_id, map_id=row.map_id, survey_id=survey_id)
            if row.status == "ready":
                history.rewrite(session, row.map_id)
        self._blobs.delete_prefix(blob_keys.survey_folder(survey_id))


def _check_unused(session: Session, row: Survey) -> None:
    """Raise Conflict while a version of the map is being built of the survey."""
    version = tables.MapVersion
    query = select(version).where(version.map_id == row.map_id, version.survey_id == row.survey_id)
    built = session.scalar(query.where(version.status == "building"))
    if built is not None:
        raise Conflict(
            f"version {built.version} of map {row.map_id!r} is being built of survey {row.survey_id!r}; wait for job "
            f"{built.job_id}, or dismiss it"
        )


def _check_ready(status: str, survey_id: str, job_id: str) -> None:
    """Raise NotReady or Failed, with the job to look at, for a survey that is not done."""
    if status == "running":
        raise NotReady(f"survey {survey_id!r} is still running; follow job {job_id}")
    if status == "failed":
        raise Failed(f"survey {survey_id!r} has no result; job {job_id} says why")


def _locked(session: Session, survey_id: str) -> Survey:
    """Return the row of a survey while nobody else works on its map. Raises NotFound."""
    map_row(session, _row(session, survey_id).map_id, lock=True)
    return _row(session, survey_id, lock=True)


def _row(session: Session, survey_id: str, *, lock: bool = False) -> Survey:
    row = session.get(Survey, survey_id, with_for_update=lock)
    if row is None:
        raise NotFound(f"no survey {survey_id!r}; GET /maps/<id>/surveys lists those there are")
    return row


def _check_numbers(objects: Sequence[ObjectRecord]) -> None:
    """Raise ValueError where two objects of a survey have one number."""
    if len({thing.number for thing in objects}) < len(objects):
        raise ValueError(f"objects have one number each, these have {[thing.number for thing in objects]}")


def _check_doubt(row: Survey, by_state: Mapping[TileState, int], *, told: bool) -> None:
    """Raise ValueError where a survey whose placement is in doubt says that something is so, or is not."""
    if row.placement is None or row.placement["state"] != "in_doubt":
        return
    if told or by_state["unchanged"] or by_state["changed"]:
        raise ValueError(
            f"the placement of survey {row.survey_id!r} is in doubt, and yet it tells objects, unchanged or changed "
            f"tiles: {dict(by_state)}"
        )


def _replace_tiles(session: Session, survey_id: str, tiles: Iterable[TileRecord]) -> None:
    """Write the tiles of a survey; one of which an earlier run said the same goes on to belong to its change."""
    told = select(SurveyTile.__table__).where(
        SurveyTile.survey_id == survey_id, SurveyTile.told_by.is_not(None)
    )
    before = {row["tile_id"]: dict(row) for row in session.execute(told).mappings()}
    session.execute(delete(SurveyTile).where(SurveyTile.survey_id == survey_id))
    for row in (_tile_row(survey_id, tile) for tile in tiles):
        earlier = before.get(row.tile_id, {})
        if earlier and all(getattr(row, name) == earlier[name] for name in earlier if name != "told_by"):
            row.told_by = earlier["told_by"]
        session.add(row)


def _replace_objects(session: Session, survey_id: str, objects: Iterable[ObjectRecord]) -> None:
    """Write the objects of a survey; one that an earlier run gave the same number keeps its id in the map."""
    query = select(SurveyObject.number, SurveyObject.object_id).where(SurveyObject.survey_id == survey_id)
    ids = dict(session.execute(query).all())
    session.execute(delete(SurveyObject).where(SurveyObject.survey_id == survey_id))
    session.add_all(
        SurveyObject(survey_id=survey_id, object_id=ids.get(thing.number), **thing.model_dump(mode="json"))
        for thing in objects
    )


def _tile_row(survey_id: str, tile: TileRecord) -> SurveyTile:
    (i, j, k), low, high = tile.tile_index, tile.bounds.min, tile.bounds.max
    p_unchanged, p_changed, p_different = tile.probabilities or (None, None, None)
    return SurveyTile(
        survey_id=survey_id,
        i=i,
        j=j,
        k=k,
        **dict(zip(("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"), (*low, *high), strict=True)),
        p_unchanged=p_unchanged,
        p_changed=p_changed,
        p_different=p_different,
        **tile.model_dump(exclude={"tile_index", "bounds", "probabilities"}),
    )
