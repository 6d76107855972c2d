"""Rows of versions, and what has to hold before one is made or deleted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import ScalarSelect, delete, exists, func, select
from sqlalchemy.orm import Session, aliased

from service.catalog import tables
from service.catalog.outcomes import checked_scan_ids, facts, outcome
from service.catalog.records import Bounds, Problem, ScanOutcome, VersionRecord
from service.catalog.scans import rows_in_order
from service.errors import BadRequest, Conflict, NotFound, NotReady


def shown() -> ScalarSelect[str]:
    """The job of the version that a row of `maps` shows: the newest that is ready, else the newest."""
    of_map = aliased(tables.MapVersion)
    query = select(of_map.job_id).where(of_map.map_id == tables.Map.id).correlate(tables.Map)
    return query.order_by(of_map.status != "ready", of_map.number.desc()).limit(1).scalar_subquery()


def map_row(session: Session, map_id: str, *, lock: bool = False) -> tables.Map:
    """One map. With `lock` nobody else makes or deletes a version of it meanwhile. Raises NotFound."""
    row = session.get(tables.Map, map_id, with_for_update=lock)
    if row is None:
        raise NotFound(f"no map {map_id!r}; GET /maps lists those there are")
    return row


def current_row(session: Session, map_id: str) -> tables.MapVersion:
    """The version in use. Raises NotFound, and NotReady where there is none yet."""
    of_map = map_row(session, map_id)
    row = session.scalars(
        select(tables.MapVersion)
        .join(tables.Map, tables.MapVersion.job_id == shown())
        .where(tables.Map.id == of_map.id)
    ).one()
    check_ready(row.status, f"map {map_id!r}", row.job_id)
    return row


def version_row(session: Session, map_id: str, number: int) -> tables.MapVersion:
    """One version. Raises NotFound."""
    map_row(session, map_id)
    row = session.scalar(
        select(tables.MapVersion).where(
            tables.MapVersion.map_id == map_id, tables.MapVersion.number == number
        )
    )
    if row is None:
        raise NotFound(
            f"no version {number} of map {map_id!r}; GET /maps/{map_id}/versions lists those there are"
        )
    return row


def row_of_job(session: Session, job_id: str) -> tables.MapVersion:
    """The version that a job builds. Raises NotFound."""
    row = session.get(tables.MapVersion, job_id)
    if row is None:
        raise NotFound(f"job {job_id!r} builds no map, or its map was deleted")
    return row


def new_row(
    job: tables.Job,
    scans: Iterable[ScanOutcome],
    *,
    number: int = 1,
    base_version: int | None = None,
    survey_id: str | None = None,
) -> tables.MapVersion:
    """A version that is going to be built by `job`."""
    return tables.MapVersion(
        job_id=job.id,
        map_id=job.map_id,
        number=number,
        status="building",
        base_version=base_version,
        survey_id=survey_id,
        counts={},
        created=job.created,
        updated=job.created,
        scans=[
            tables.VersionScan(scan_id=scan.scan_id, ordinal=n, **facts(scan)) for n, scan in enumerate(scans)
        ],
    )


def next_number(session: Session, map_id: str) -> int:
    """One more than the largest there is. Raises Conflict while another version builds."""
    of_map = tables.MapVersion.map_id == map_id
    building = session.scalar(select(tables.MapVersion).where(of_map, tables.MapVersion.status == "building"))
    if building is not None:
        raise Conflict(
            f"version {building.number} of map {map_id!r} is still building (job {building.job_id}); one version "
            "builds at a time"
        )
    return 1 + (session.scalar(select(func.max(tables.MapVersion.number)).where(of_map)) or 0)


def further_scans(session: Session, scan_ids: Sequence[str], base: tables.MapVersion) -> list[ScanOutcome]:
    """Scans that are still to be registered. Raises NotFound, and BadRequest for one that is in `base`."""
    scan_ids = checked_scan_ids(scan_ids)
    rows_in_order(session, scan_ids)
    known = _named(set(scan_ids) & {scan.scan_id for scan in kept_scans(base)})
    if known:
        raise BadRequest(f"scan {known} is in version {base.number} of the map; send further ones")
    return [ScanOutcome(scan_id=scan_id) for scan_id in scan_ids]


def survey_scans(session: Session, survey_id: str, base: tables.MapVersion) -> list[ScanOutcome]:
    """The accepted scans of a survey, which stays until the session ends.

    Raises NotFound, also for a survey of another map, NotReady, and Conflict where `base` has taken it over.
    """
    survey = session.get(tables.Survey, survey_id, with_for_update=True)
    if survey is None or survey.map_id != base.map_id:
        raise NotFound(f"no survey {survey_id!r} of map {base.map_id!r}")
    if survey.status != "ready":
        raise NotReady(f"survey {survey_id!r} is {survey.status}; look at job {survey.job_id}")
    found = [scan for scan in map(outcome, survey.scans) if scan.accepted]
    known = _named({scan.scan_id for scan in found} & {scan.scan_id for scan in kept_scans(base)})
    if known:
        raise Conflict(f"version {base.number} of the map holds scan {known} of survey {survey_id!r} already")
    return found


def kept_scans(base: tables.MapVersion) -> list[ScanOutcome]:
    """What a later version keeps: the accepted scans."""
    return [scan for scan in map(outcome, base.scans) if scan.accepted]


def check_deletable(session: Session, row: tables.MapVersion) -> None:
    """Raises Conflict for the version in use, one that builds, and one that a survey or a model needs meanwhile."""
    name = f"version {row.number} of map {row.map_id!r}"
    if row.status == "building":
        raise Conflict(f"{name} is still building; dismiss job {row.job_id} first")
    if row.job_id == session.scalar(select(shown()).where(tables.Map.id == row.map_id)):
        raise Conflict(f"{name} is the one in use; delete the map, or make a newer version first")
    compared = exists().where(
        tables.Survey.map_id == row.map_id,
        tables.Survey.map_version == row.number,
        tables.Survey.status == "running",
    )
    if session.scalar(select(compared)):
        raise Conflict(f"a survey is being compared with {name}; wait for it, or dismiss its job")
    trained = exists().where(
        tables.Model.map_id == row.map_id,
        tables.Model.map_version == row.number,
        tables.Model.status == "training",
    )
    if session.scalar(select(trained)):
        raise Conflict(f"a model is being trained on {name}; wait for it, or dismiss its job")


def forget(session: Session, row: tables.MapVersion) -> None:
    """Delete a version and its job."""
    session.execute(delete(tables.Job).where(tables.Job.id == row.job_id))
    session.delete(row)


def check_ready(status: str, what: str, job_id: str) -> None:
    """Raises NotReady with the job to look at."""
    if status == "building":
        raise NotReady(f"{what} is still building; follow job {job_id}")
    if status == "failed":
        raise NotReady(f"{what} could not be built; job {job_id} says why")


def version_record(row: tables.MapVersion, of: tables.Map, problem: dict[str, Any] | None) -> VersionRecord:
    """The record of a row."""
    return VersionRecord(
        map_id=row.map_id,
        version=row.number,
        status=row.status,
        base_version=row.base_version,
        survey_id=row.survey_id,
        model=of.model,
        settings=of.settings,
        scans=tuple(outcome(scan) for scan in row.scans),
        bounds=None if row.bounds is None else Bounds.model_validate(row.bounds),
        counts=row.counts,
        registration=row.registration,
        job_id=row.job_id,
        problem=None if problem is None else Problem.model_validate(problem),
        created=row.created,
        updated=row.updated,
    )


def _named(scan_ids: Iterable[str]) -> str:
    return ", ".join(map(repr, sorted(scan_ids)))
