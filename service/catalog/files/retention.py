"""Retention: what is older than it has to be kept, and files whose row is gone.

Nothing goes that a version of a map rests on, and nothing of a job that is not over. Several processes may sweep at
once: each thing is looked at again when its turn comes, and one that is gone by then is not missed.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from sqlalchemy import ColumnElement, Select, and_, exists, false, or_, select
from sqlalchemy.orm import Session

from service.catalog import idempotency, tallies
from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.catalog.sql.tables import Job, MapVersion, Model, Scan, Survey, SurveyScan, VersionScan
from service.errors import Conflict, NotFound
from service.settings import Settings

log = logging.getLogger(__name__)

ABANDONED = timedelta(days=1)  #: a file without a row is on its way in for less than this
_FEW = 3  #: folders without a row that may go beside few that have one


@dataclass(frozen=True, kw_only=True, slots=True)
class Leftovers:
    """What may go."""

    surveys: tuple[str, ...] = ()  #: ids, oldest first
    scans: tuple[str, ...] = ()  #: ids, oldest first; some become free only when the surveys have gone
    folders: tuple[str, ...] = ()  #: of blobs that no row names
    folders_known: int = field(default=0)  #: that a row names

    @property
    def doubtful(self) -> bool:
        """Whether more files have no row than kills leave: rather a wrong database, an empty one, or an old copy."""
        return len(self.folders) > (max(_FEW, self.folders_known // 10) if self.folders_known else 0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Policy:
    """How long things are kept, at one instant; None is for ever."""

    scans_before: datetime | None  #: scans that nobody sent since go
    surveys_before: datetime | None  #: surveys that were asked for earlier go
    files_before: datetime  #: files without a row that were written earlier go
    keys_before: datetime  #: answers under an Idempotency-Key that were given earlier go


def policy_of(settings: Settings, at: datetime) -> Policy:
    """Return what the settings `keep_scans_days` and `keep_surveys_days` mean at this instant."""

    def before(days: float) -> datetime | None:
        return at - timedelta(days=days) if days else None

    return Policy(
        scans_before=before(settings.keep_scans_days),
        surveys_before=before(settings.keep_surveys_days),
        files_before=at - ABANDONED,
        keys_before=at - timedelta(hours=settings.keep_idempotency_keys_hours),
    )


def find(catalog: Catalog, policy: Policy) -> Leftovers:
    """Return what goes now under a policy; nothing is changed."""
    with catalog.database.read() as session:
        surveys = tuple(session.scalars(_surveys(policy)))
        scans = tuple(session.scalars(_scans(policy)))
    folders, known = _folders(catalog, policy)
    return Leftovers(surveys=surveys, scans=scans, folders=folders, folders_known=known)


def remove(catalog: Catalog, policy: Policy, leftovers: Leftovers) -> dict[str, int]:
    """Delete what `find` has found, where that still holds; returns how many of each kind went."""
    swept = {
        "surveys": sum(_remove_survey(catalog, policy, survey_id) for survey_id in leftovers.surveys),
        "scans": sum(_remove_scan(catalog, policy, scan_id) for scan_id in leftovers.scans),
        "folders": len(leftovers.folders),
    }
    for folder in leftovers.folders:
        catalog.blobs.delete_prefix(folder)
    with catalog.database.write() as session:
        idempotency.forget(session, policy.keys_before)
        for what, number in swept.items():
            if number:
                tallies.add(session, tallies.SWEPT.name, {"what": what}, number)
    return swept


def _surveys(policy: Policy) -> Select[str]:
    """Return a query for the surveys that go: old, over, and taken over by no version."""
    if policy.surveys_before is None:
        return select(Survey.survey_id).where(false())
    taken = exists().where(MapVersion.map_id == Survey.map_id, MapVersion.survey_id == Survey.survey_id)
    works = exists().where(Job.survey_id == Survey.survey_id, Job.status.in_(("accepted", "running")))
    over = and_(Survey.status != "running", ~works)
    query = select(Survey.survey_id).where(Survey.created < policy.surveys_before, over, ~taken)
    return query.order_by(Survey.created)


def _scans(policy: Policy) -> Select[str]:
    """Return a query for the scans that go: old, and in nothing but surveys that go."""
    if policy.scans_before is None:
        return select(Scan.scan_id).where(false())
    of_version = exists().where(VersionScan.scan_id == Scan.scan_id)
    stays = SurveyScan.survey_id.not_in(_surveys(policy).order_by(None))
    of_survey = exists().where(SurveyScan.scan_id == Scan.scan_id, stays)
    idle = unused_since(policy.scans_before)
    return select(Scan.scan_id).where(idle, ~of_version, ~of_survey).order_by(Scan.created)


def unused_since(before: datetime) -> ColumnElement[bool]:
    """Return the condition that nobody has sent a scan since."""
    return and_(Scan.created < before, or_(Scan.resent.is_(None), Scan.resent < before))


def _folders(catalog: Catalog, policy: Policy) -> tuple[tuple[str, ...], int]:
    """Return the folders of blobs without a row, and how many have one.

    The blobs are listed first: what comes in meanwhile is not among them.
    """
    listed = {root: catalog.blobs.folders(root) for root in blob_keys.ROOTS}
    with catalog.database.read() as session:
        known = {root: set(_known(session, root)) for root in blob_keys.ROOTS}
    gone = [folder for root, folders in listed.items() for folder in folders if folder not in known[root]]
    old = tuple(folder for folder in gone if _old(catalog.blobs.written(folder), policy))
    return old, sum(map(len, listed.values())) - len(gone)


def _old(written: datetime | None, policy: Policy) -> bool:
    return written is not None and written < policy.files_before


def _known(session: Session, root: str) -> Iterable[str]:
    """Return the folders that rows name."""
    if root == "scans":
        return map(blob_keys.folder_of, session.scalars(select(Scan.key)))
    if root == "surveys":
        return map(blob_keys.survey_folder, session.scalars(select(Survey.survey_id)))
    if root == "models":
        return map(blob_keys.model_folder, session.scalars(select(Model.job_id)))
    return map(blob_keys.map_folder, session.scalars(select(MapVersion.job_id)))


def _remove_survey(catalog: Catalog, policy: Policy, survey_id: str) -> bool:
    with catalog.database.read() as session:
        if session.scalar(_surveys(policy).where(Survey.survey_id == survey_id)) is None:
            return False
    with contextlib.suppress(NotFound, Conflict):  # another sweep was first; a version is built of it
        catalog.surveys.delete(survey_id)
        return True
    return False


def _remove_scan(catalog: Catalog, policy: Policy, scan_id: str) -> bool:
    if policy.scans_before is None:
        return False
    return catalog.scans.forget(scan_id, unused_since(policy.scans_before))
