"""What a version of a map is made of: scans alone, or the version before it and what came since."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.catalog.files import blob_keys
from service.catalog.records import ScanOutcome, VersionRecord
from worker.cloud import npz
from worker.cloud.seen import Seen
from worker.cloud.types import Indices
from worker.detectors.detector import Detector
from worker.errors import GaveWay, MapFailed
from worker.jobs.pair_cache import StoredPairCache
from worker.jobs.scans import kept_scans, save_scans, scan_files, scan_outcomes, seen_by
from worker.jobs.step import Context, load, put
from worker.pipeline import archive
from worker.pipeline.alarms import AlarmCalibration, calibrated, visits_of
from worker.pipeline.flow import BuiltMap, NoScanAccepted, NothingToTile, build_map
from worker.pipeline.map_update import KeptMap, extend_map, renew_map, without
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.pipeline.settings import PipelineSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class Made:
    """A version that was built; its scans are kept, all else of it is still to be saved."""

    built: BuiltMap
    outcomes: tuple[ScanOutcome, ...]  #: of every scan of the version

    def registration(self) -> dict[str, Any] | None:
        """Return the totals of the registration, with the reference scan by its id; None where there was none."""
        if self.built.report is None:
            return None
        totals = self.built.report.document()
        reference = totals["reference"]
        return {**totals, "reference": None if reference is None else self.outcomes[reference].scan_id}


def kept_reference(context: Context, version: VersionRecord) -> ReferenceMap:
    """Return the map of a version, also one that release 0.1 built. Raises MapFailed for a file of another kind."""
    blobs, tiles_of_0_1 = context.catalog.blobs, blob_keys.map_tiles(version.job_id)
    with ExitStack() as stack:
        path = stack.enter_context(blobs.local(blob_keys.map_reference(version.job_id)))
        grid = stack.enter_context(blobs.local(tiles_of_0_1)) if blobs.exists(tiles_of_0_1) else None
        try:
            return archive.load_reference(path, tiles_of_0_1=grid)
        except ValueError as unknown:
            raise MapFailed(
                f"version {version.version} of map {version.map_id} is kept in files that this release cannot read; "
                "build the map anew from its scans"
            ) from unknown


def kept_seen(context: Context, version: VersionRecord, *, voxel_size: float) -> Seen:
    """Return what the scans of a version saw; of a map of release 0.1, whose scans are kept, it is made now and kept.

    Raises MapFailed where the scans are gone.
    """
    key_of = functools.partial(blob_keys.map_scan, version.job_id)
    try:
        return seen_by(
            context,
            blob_keys.map_seen(version.job_id),
            kept_scans(context, version.scans, key_of),
            voxel_size=voxel_size,
        )
    except FileNotFoundError as missing:
        raise MapFailed(
            f"version {version.version} of map {version.map_id} comes from a release that did not keep what its scans "
            "saw, and not all of the scans are there; build the map anew from its scans, or ask for a model that "
            "compares tiles by their points"
        ) from missing


def kept_alarms(
    context: Context, version: VersionRecord, detector: Detector, model: str, settings: PipelineSettings
) -> AlarmCalibration:
    """Return how strong a region has to be on this map for this model; made of the map's own scans on first use."""
    key = blob_keys.map_alarms(version.job_id, model, detector.card.fingerprint)
    if context.catalog.blobs.exists(key):
        return load(context, key, functools.partial(npz.load, kind=AlarmCalibration))
    key_of = functools.partial(blob_keys.map_scan, version.job_id)
    visits = visits_of(
        kept_scans(context, version.scans, key_of), voxel_size=settings.registration.voxel_size
    )
    calibration = calibrated(
        visits, detector, alarms_per_survey=settings.alarms_per_survey, progress=context.report
    )
    put(context, key, functools.partial(npz.save, value=calibration))
    return calibration


def make_version(
    context: Context, version: VersionRecord, settings: PipelineSettings, *, refused: Mapping[str, str]
) -> Made:
    """Build a version. What became of its scans is recorded also where that fails.

    `refused` has, by the id of a scan, why it is not read.
    """
    if version.base_version is None:
        return _first(context, version, settings, refused)
    base = context.catalog.versions.get(version.map_id, version.base_version)
    if version.survey_id is None:
        return _extended(context, version, base, settings, refused)
    return _renewed(context, version, base, version.survey_id, settings)


def _first(
    context: Context, version: VersionRecord, settings: PipelineSettings, refused: Mapping[str, str]
) -> Made:
    with ExitStack() as stack:
        files = scan_files(context, version.scans, stack, settings, refused=refused)
        with _recorded_anyway(context, version.scans):
            pairs = StoredPairCache(context.catalog.blobs, context.job.job_id)
            try:
                built = build_map(files, settings=settings, pairs=pairs, progress=context.report)
            except GaveWay:
                pairs.flush()
                raise
        save_scans(context, version.scans, files, built.outcomes, _key_of(context))
    return Made(built=built, outcomes=scan_outcomes(version.scans, built.outcomes))


def _extended(
    context: Context,
    version: VersionRecord,
    base: VersionRecord,
    settings: PipelineSettings,
    refused: Mapping[str, str],
) -> Made:
    older, further = _kept(base), _further(version, base)
    with ExitStack() as stack:
        files = scan_files(context, further, stack, settings, refused=refused)
        with _recorded_anyway(context, further):
            kept = _kept_map(context, base, settings)
            built = extend_map(kept, files, settings=settings, progress=context.report)
        for scan in older:
            context.catalog.blobs.copy(
                blob_keys.map_scan(base.job_id, scan.scan_id), _key_of(context)(scan.scan_id)
            )
        save_scans(context, further, files, built.outcomes, _key_of(context))
    return Made(built=built, outcomes=(*older, *scan_outcomes(further, built.outcomes)))


def _renewed(
    context: Context, version: VersionRecord, base: VersionRecord, survey_id: str, settings: PipelineSettings
) -> Made:
    older, seen = _kept(base), _further(version, base)
    kept, replaced = _kept_map(context, base, settings), _changed(context, survey_id)
    survey_key = functools.partial(blob_keys.survey_scan, survey_id)
    loads = kept_scans(context, seen, survey_key)
    built = renew_map(kept, loads, replaced=replaced, settings=settings, progress=context.report)
    for done, (scan, load_kept) in enumerate(zip(older, kept.scans, strict=True)):
        context.report("saving", done / len(older))
        rest = without(load_kept(), kept.reference.grid, replaced)
        put(context, _key_of(context)(scan.scan_id), functools.partial(npz.save, value=rest))
    for scan in seen:
        context.catalog.blobs.copy(survey_key(scan.scan_id), _key_of(context)(scan.scan_id))
    return Made(built=built, outcomes=(*older, *seen))


def _kept_map(context: Context, base: VersionRecord, settings: PipelineSettings) -> KeptMap:
    key_of = functools.partial(blob_keys.map_scan, base.job_id)
    return KeptMap(
        reference=kept_reference(context, base),
        scans=kept_scans(context, base.scans, key_of),
        seen=kept_seen(context, base, voxel_size=settings.registration.voxel_size),
    )


def _kept(base: VersionRecord) -> list[ScanOutcome]:
    return [scan for scan in base.scans if scan.accepted]


def _further(version: VersionRecord, base: VersionRecord) -> list[ScanOutcome]:
    """Return what the version has beside its base; an earlier run of the step may have recorded outcomes of these."""
    older = {scan.scan_id for scan in _kept(base)}
    return [scan for scan in version.scans if scan.scan_id not in older]


def _changed(context: Context, survey_id: str) -> Indices:
    """Return (T, 3) the tiles that the survey found changed."""
    changes = context.catalog.changes.of_survey(survey_id)
    changed = [change.tile.tile_index for change in changes if change.tile.state == "changed"]
    return np.array(changed, np.int32).reshape(-1, 3)


def _key_of(context: Context) -> functools.partial[str]:
    return functools.partial(blob_keys.map_scan, context.job.job_id)


@contextmanager
def _recorded_anyway(context: Context, scans: Sequence[ScanOutcome]) -> Iterator[None]:
    """Record what became of the scans where no map comes of them."""
    try:
        yield
    except (NoScanAccepted, NothingToTile) as error:
        context.catalog.versions.save_outcomes(context.job.job_id, scan_outcomes(scans, error.outcomes))
        raise
