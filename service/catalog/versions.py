"""Versions of a map: the first from its scans, each later one from the version in use and what came since."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, delete, exists, func, select
from sqlalchemy.orm import Session, aliased, contains_eager, selectinload, undefer

from service.catalog import tallies
from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.idempotency import ANY_TIMES, Once
from service.catalog.jobs import new_job
from service.catalog.records import (
    Bounds,
    JobRecord,
    Matrix,
    Page,
    Position,
    ScanOutcome,
    Tileset,
    VersionRecord,
    VersionSummary,
)
from service.catalog.scans import (
    NO_POSES,
    checked_scan_ids,
    known_outcomes,
    new_uses,
    outcome_columns,
    put_in_place,
    scans_in_order,
    write_outcomes,
)
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.sql.tables import MapVersion, now
from service.errors import BadRequest, Conflict, Failed, Gone, NotFound, NotReady

ScanPosition = tuple[str, int]  #: in a list of scans: the job of their version, and how many came before


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanPage:
    """Some scans of a version, in its order."""

    version: int  #: 1, 2, ... of the map
    items: Sequence[ScanOutcome]
    following: ScanPosition | None  #: None where there is no more


class Versions:
    """The versions of the catalog's maps."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database = database
        self._blobs = blobs

    def create(
        self,
        map_id: str,
        *,
        scan_ids: Sequence[str] = (),
        poses: Mapping[str, Matrix] = NO_POSES,
        survey_id: str | None = None,
        once: Once = ANY_TIMES,
    ) -> tuple[VersionRecord, JobRecord]:
        """Record a version of further scans or of an accepted survey, and its job; the one in use is its base.

        `poses` of further scans, by id, count for this version alone.

        Raises NotFound (map, survey, scan), NotReady (map, survey), BadRequest (the scans; both or neither of the two),
        Conflict (another version builds; the base has taken the survey over), and what `once` does.
        """
        if bool(scan_ids) == (survey_id is not None):
            raise BadRequest(
                "a version is made either of scans (scan_ids or files) or of one survey (survey_id)"
            )
        with self._database.write() as session:
            once.claim(session)
            map_row(session, map_id, lock=True)
            base = version_in_use(session, map_id)
            number = _next_number(session, map_id)
            if survey_id is None:
                new = _further_scans(session, scan_ids, poses, base)
            else:
                new = _survey_scans(session, survey_id, base)
            job = new_job("map", map_id)
            row = new_version(job, [*_accepted(base.scans), *new], number)
            row.base_version, row.survey_id = base.version, survey_id
            session.add_all([row, job])
            session.flush()
            made = VersionRecord.of_row(row), JobRecord.of_row(job)
            once.keep(session, *made, job=job)
            return made

    def get(self, map_id: str, number: int, *, scans: int | None = None) -> VersionRecord:
        """Return one version, with its first `scans` scans; left out: with all. Raises NotFound."""
        with self._database.read() as session:
            row = _row(session, map_id, number)
            return VersionRecord(**dict(VersionSummary.of_row(row)) | parts_of(session, row, scans))

    def ready(self, map_id: str, number: int) -> VersionRecord:
        """Return one version that is built. Raises NotFound and NotReady."""
        version = self.get(map_id, number)
        check_ready(version.status, f"version {number} of map {map_id!r}", version.job_id)
        return version

    def scans(
        self, map_id: str, number: int | None = None, *, after: ScanPosition | None = None, limit: int = 100
    ) -> ScanPage:
        """Return what became of the scans of a version, in its order; of the one that the map shows where none is named.

        A list goes on in the version that it began in, whichever the map shows by then. Raises NotFound, BadRequest for
        a position in the list of another version, and Gone where its version was deleted.
        """
        with self._database.read() as session:
            row, before = _listed(session, map_id, number, after)
            scans = _scans_of(session, row.job_id, before, limit + 1)
            following = (row.job_id, before + limit) if len(scans) > limit else None
            return ScanPage(version=row.version, items=scans[:limit], following=following)

    def tileset(self, map_id: str, number: int) -> tuple[str, Tileset]:
        """Return the job of a version that is built, and its tileset; of the scans nothing is read.

        Viewers ask hundreds of times. Raises NotFound, also for a version without a tileset, and NotReady.
        """
        what = f"version {number} of map {map_id!r}"
        with self._database.read() as session:
            row = _row(session, map_id, number)
            check_ready(row.status, what, row.job_id)
            return row.job_id, tileset_of(row.tileset, what)

    def of_job(self, job_id: str) -> VersionRecord:
        """Return the version that a job builds. Raises NotFound, also where it was deleted since."""
        with self._database.read() as session:
            return VersionRecord.of_row(_row_of_job(session, job_id))

    def page(self, map_id: str, *, after: Position | None = None, limit: int = 100) -> Page[VersionSummary]:
        """Return versions of a map, newest first. Raises NotFound."""
        with self._database.read() as session:
            map_row(session, map_id)
        query = versions_in_short().where(MapVersion.map_id == map_id)
        created, key = MapVersion.created, MapVersion.job_id
        return self._database.page(query, created, key, VersionSummary.of_row, after=after, limit=limit)

    def take_apart(
        self, key: str, scan_id: str, parts: Mapping[str, Matrix | None], *, keep: bool = False
    ) -> None:
        """Put the scans that one of a version's was taken apart into in its place, with their poses.

        `key` is the id of the job that builds the version. Raises NotFound, also where it was deleted since.
        """
        with self._database.write() as session:
            row = _row_of_job(session, key)
            put_in_place(tables.VersionScan, row.scans, scan_id, parts, keep=keep)
            row.updated = now()

    def save_outcomes(self, job_id: str, outcomes: Iterable[ScanOutcome]) -> None:
        """Record what became of the scans, also when the version then fails. Raises NotFound."""
        outcomes = tuple(outcomes)
        with self._database.write() as session:
            row = _row_of_job(session, job_id)
            tallies.tally_outcomes(session, "map", outcomes, known_outcomes(row.scans))
            write_outcomes(session, row.scans, outcomes)
            row.updated = now()

    def save_result(
        self,
        job_id: str,
        *,
        outcomes: Iterable[ScanOutcome],
        bounds: Bounds,
        counts: Mapping[str, int],
        registration: Mapping[str, Any] | None = None,
        tileset: Tileset | None = None,
    ) -> None:
        """Record what was built, replacing an earlier run's result; `jobs.succeed` makes it ready.

        Raises NotFound, also where the version was deleted since.
        """
        outcomes = tuple(outcomes)
        with self._database.write() as session:
            row = _row_of_job(session, job_id)
            tallies.tally_outcomes(session, "map", outcomes, known_outcomes(row.scans))
            write_outcomes(session, row.scans, outcomes)
            row.bounds = bounds.model_dump(mode="json")
            row.counts = dict(counts)
            row.registration = None if registration is None else dict(registration)
            row.tileset = None if tileset is None else tileset.model_dump()
            row.updated = now()

    def delete(self, map_id: str, number: int) -> None:
        """Delete a version with its job and files; surveys that were compared with it stay.

        Raises NotFound, and Conflict for the version in use, one that builds, and one that a survey still needs.
        """
        with self._database.write() as session:
            map_row(session, map_id, lock=True)
            row = _row(session, map_id, number)
            _check_deletable(session, row)
            folder = blob_keys.map_folder(row.job_id)
            _delete(session, row)
        self._blobs.delete_prefix(folder)

    def take_back(self, job_id: str) -> None:
        """Delete a version whose job never reached the queue."""
        with self._database.write() as session:
            _delete(session, _row_of_job(session, job_id))


def tileset_of(told: Tileset | dict[str, Any] | None, what: str) -> Tileset:
    """Return the tileset that a row or a record tells of. Raises NotFound where there is none."""
    if told is None:
        raise NotFound(
            f"{what} has no tileset: an earlier release built it, or its cloud is small; read cloud.ply"
        )
    return Tileset.model_validate(told)


def map_row(session: Session, map_id: str, *, lock: bool = False) -> tables.Map:
    """Return the row of a map; with `lock` nobody else makes or deletes a version of it meanwhile. Raises NotFound."""
    row = session.get(tables.Map, map_id, with_for_update=lock)
    if row is None:
        raise NotFound(f"no map {map_id!r}; GET /maps lists those there are")
    return row


def whole_versions() -> Select[MapVersion]:
    """Return a query for versions with all that their records show."""
    related = (
        selectinload(MapVersion.scans),
        selectinload(MapVersion.job),
        contains_eager(MapVersion.of_map),
    )
    return select(MapVersion).join(MapVersion.of_map).options(*related)


def versions_in_short() -> Select[MapVersion]:
    """Return a query for versions with what their summaries show."""
    related = (
        undefer(MapVersion.scan_count),
        selectinload(MapVersion.job),
        contains_eager(MapVersion.of_map),
    )
    return select(MapVersion).join(MapVersion.of_map).options(*related)


def in_use(versions: Select[MapVersion]) -> Select[MapVersion]:
    """Keep the version that each map shows: the newest that is ready, else the newest."""
    other = aliased(MapVersion)
    newest = select(other.job_id).where(other.map_id == tables.Map.map_id).correlate(tables.Map)
    newest = newest.order_by(other.status != "ready", other.version.desc()).limit(1)
    return versions.where(MapVersion.job_id == newest.scalar_subquery())


def version_in_use(session: Session, map_id: str) -> MapVersion:
    """Return the row of the version in use. Raises NotFound, and NotReady where there is none yet."""
    row = shown_version(session, map_id)
    check_ready(row.status, f"map {map_id!r}", row.job_id)
    return row


def shown_version(session: Session, map_id: str) -> MapVersion:
    """Return the row of the version that a map shows, whatever its state. Raises NotFound."""
    return _shown(session, map_id, whole_versions())


def shown_in_short(session: Session, map_id: str) -> MapVersion:
    """Return the same row for what a summary shows, without its scans. Raises NotFound."""
    return _shown(session, map_id, versions_in_short())


def _shown(session: Session, map_id: str, versions: Select[MapVersion]) -> MapVersion:
    row = session.scalar(in_use(versions).where(tables.Map.map_id == map_id))
    if row is None:
        raise NotFound(f"no map {map_id!r}; GET /maps lists those there are")
    return row


def new_version(job: tables.Job, scans: Iterable[ScanOutcome], number: int) -> MapVersion:
    """Return the row of a version that is going to be built by `job`."""
    return MapVersion(
        job_id=job.job_id,
        map_id=job.map_id,
        version=number,
        status="building",
        counts={},
        created=job.created,
        updated=job.created,
        scans=[
            tables.VersionScan(scan_id=scan.scan_id, ordinal=n, **outcome_columns(scan))
            for n, scan in enumerate(scans)
        ],
    )


def parts_of(session: Session, row: MapVersion, scans: int | None) -> dict[str, Any]:
    """Return what the record of a version has beside its summary: of its scans the first, or all for None."""
    told = tuple(_scans_of(session, row.job_id, 0, scans))
    return {"settings": row.settings, "registration": row.registration, "scans": told}


def _scans_of(session: Session, job_id: str, before: int, limit: int | None) -> list[ScanOutcome]:
    """Return scans of a version behind the first `before`."""
    of_version = (tables.VersionScan.job_id == job_id, tables.VersionScan.ordinal >= before)
    query = select(tables.VersionScan).where(*of_version).order_by(tables.VersionScan.ordinal).limit(limit)
    return [ScanOutcome.of_row(row) for row in session.scalars(query)]


def _listed(
    session: Session, map_id: str, number: int | None, after: ScanPosition | None
) -> tuple[MapVersion, int]:
    """Return the version whose scans are listed, and how many of them came before. Raises as `Versions.scans` does."""
    if after is None:
        return shown_in_short(session, map_id) if number is None else _row(session, map_id, number), 0
    map_row(session, map_id)
    job_id, before = after
    row = session.get(MapVersion, job_id)
    if row is None:
        raise Gone(f"the version of map {map_id!r} whose scans the cursor lists was deleted; begin anew")
    if row.map_id != map_id or number not in (None, row.version):
        raise BadRequest("the cursor is of the scans of another version; follow a `next` link")
    return row, before


def check_ready(status: str, what: str, job_id: str) -> None:
    """Raise NotReady, or Failed, with the job to look at, unless it is ready."""
    if status == "building":
        raise NotReady(f"{what} is still building; follow job {job_id}")
    if status == "failed":
        raise Failed(f"{what} could not be built; job {job_id} says why")


def _row(session: Session, map_id: str, number: int) -> MapVersion:
    map_row(session, map_id)
    query = select(MapVersion).where(MapVersion.map_id == map_id, MapVersion.version == number)
    row = session.scalar(query)
    if row is None:
        raise NotFound(
            f"no version {number} of map {map_id!r}; GET /maps/{map_id}/versions lists those there are"
        )
    return row


def _row_of_job(session: Session, job_id: str) -> MapVersion:
    row = session.get(MapVersion, job_id)
    if row is None:
        raise NotFound(f"job {job_id!r} builds no map, or its map was deleted")
    return row


def _next_number(session: Session, map_id: str) -> int:
    """Return one more than the largest there is. Raises Conflict while another version builds."""
    of_map = MapVersion.map_id == map_id
    building = session.scalar(select(MapVersion).where(of_map, MapVersion.status == "building"))
    if building is not None:
        raise Conflict(
            f"version {building.version} of map {map_id!r} is still building (job {building.job_id}); one version "
            "builds at a time"
        )
    return 1 + (session.scalar(select(func.max(MapVersion.version)).where(of_map)) or 0)


def _further_scans(
    session: Session, scan_ids: Sequence[str], poses: Mapping[str, Matrix], base: MapVersion
) -> list[ScanOutcome]:
    """Return scans that are still to be registered. Raises NotFound, and BadRequest for one that is in `base`."""
    scan_ids = checked_scan_ids(scan_ids)
    scans = scans_in_order(session, scan_ids)
    known = _shared(base, scan_ids)
    if known:
        raise BadRequest(f"scan {known} is in version {base.version} of the map; send further ones")
    return list(new_uses(scans, poses))


def _survey_scans(session: Session, survey_id: str, base: MapVersion) -> list[ScanOutcome]:
    """Return the accepted scans of a survey, which stays until the session ends.

    Raises NotFound, also for a survey of another map, NotReady, and Conflict where its placement is in doubt or `base`
    has taken it over.
    """
    survey = session.get(tables.Survey, survey_id, with_for_update=True)
    if survey is None or survey.map_id != base.map_id:
        raise NotFound(f"no survey {survey_id!r} of map {base.map_id!r}")
    if survey.status != "ready":
        error = Failed if survey.status == "failed" else NotReady
        raise error(f"survey {survey_id!r} is {survey.status}; look at job {survey.job_id}")
    _check_placed(survey)
    scans = _accepted(survey.scans)
    known = _shared(base, [scan.scan_id for scan in scans])
    if known:
        raise Conflict(
            f"version {base.version} of the map holds scan {known} of survey {survey_id!r} already"
        )
    return scans


def _check_placed(survey: tables.Survey) -> None:
    """Raise Conflict where the placement of a survey is in doubt; what it saw may be another place."""
    placement = survey.placement
    if placement is None or placement["state"] != "in_doubt":
        return
    raise Conflict(
        f"the placement of survey {survey.survey_id!r} is in doubt (confidence {placement['confidence']:.2f}), so the "
        "map does not take it over; visit the place again, with pose priors or with scans that show more of what the map "
        "holds"
    )


def _accepted(rows: Iterable[tables.VersionScan | tables.SurveyScan]) -> list[ScanOutcome]:
    """Return the accepted scans: what a later version keeps."""
    return [ScanOutcome.of_row(row) for row in rows if row.accepted]


def _shared(base: MapVersion, scan_ids: Iterable[str]) -> str:
    """Name those of the scans that `base` holds."""
    kept = {scan.scan_id for scan in _accepted(base.scans)}
    return ", ".join(map(repr, sorted(kept.intersection(scan_ids))))


def _check_deletable(session: Session, row: MapVersion) -> None:
    """Raise Conflict for the version in use, one that builds, and one that a survey or a model needs meanwhile."""
    name = f"version {row.version} of map {row.map_id!r}"
    if row.status == "building":
        raise Conflict(f"{name} is still building; dismiss job {row.job_id} first")
    if row is shown_version(session, row.map_id):
        raise Conflict(f"{name} is the one in use; delete the map, or make a newer version first")
    if _needed(session, row, tables.Survey, "running"):
        raise Conflict(f"a survey is being compared with {name}; wait for it, or dismiss its job")
    if _needed(session, row, tables.Model, "training"):
        raise Conflict(f"a model is being trained on {name}; wait for it, or dismiss its job")


def _needed(
    session: Session, row: MapVersion, by: type[tables.Survey] | type[tables.Model], status: str
) -> bool:
    of_version = (by.map_id == row.map_id, by.map_version == row.version, by.status == status)
    return bool(session.scalar(select(exists().where(*of_version))))


def _delete(session: Session, row: MapVersion) -> None:
    """Delete a version and its job."""
    session.execute(delete(tables.Job).where(tables.Job.job_id == row.job_id))
    session.delete(row)
