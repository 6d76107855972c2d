"""New versions of a map: further scans extend it, an accepted survey renews it; frame, grid and ids of tiles stay."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from worker.cloud.seen import Seen
from worker.cloud.tiling import TileGrid
from worker.cloud.types import Indices
from worker.pipeline.flow import (
    BuiltMap,
    NoScanAccepted,
    accepted_scans,
    fused_scans,
    tiled_map,
    watched,
)
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.pipeline.mapping.map_registration import MapReport
from worker.pipeline.mapping.survey_registration import register_survey_scans
from worker.pipeline.registration.results import RegisteredScan, ScanFile, with_carrier
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True, slots=True)
class KeptMap:
    """A map as an earlier build left it; its scans are loaded one at a time."""

    reference: ReferenceMap
    scans: Sequence[Callable[[], RegisteredScan]]
    seen: Seen  #: what its scans saw


def extend_map(
    base: KeptMap, files: Sequence[ScanFile], *, settings: PipelineSettings, progress: Progress = no_progress
) -> BuiltMap:
    """Extend a map: register further scans to it and fuse them with what it was made of; tiles keep their ids.

    The outcomes are those of the new files. Raises ScanError where no file can be read, NoScanAccepted where none
    finds a place, and NothingToTile.
    """
    files = with_carrier(files, settings.carrier, max_points=settings.max_scan_points)
    outcomes = register_survey_scans(
        files,
        base.reference.surface(),
        settings=settings.joint_registration,
        sights=base.seen.sights,
        growing=True,
        progress=progress,
    ).outcomes
    if not any(outcome.registration for outcome in outcomes):
        raise NoScanAccepted(outcomes)
    sights = [base.seen.sights]
    further = watched(accepted_scans(files, outcomes, settings), sights)
    scans = itertools.chain((load() for load in base.scans), further)
    fused = fused_scans(scans, len(base.scans) + len(files), settings, progress)
    reference, tiles = tiled_map(fused, base.reference.grid, outcomes, settings, progress)
    return BuiltMap(
        reference=reference,
        tiles=tiles,
        outcomes=outcomes,
        report=MapReport.of(outcomes),
        seen=Seen.of_voxels(fused, sights),
    )


def renew_map(
    base: KeptMap,
    seen: Sequence[Callable[[], RegisteredScan]],
    *,
    replaced: Indices,
    settings: PipelineSettings,
    progress: Progress = no_progress,
) -> BuiltMap:
    """Renew a map by a survey that was accepted as the new state of things; tiles keep their ids.

    In the tiles `replaced` (T, 3) the survey's points take the place of the older ones, elsewhere they join them.
    There the older scans no longer count as having looked: what they saw through may stand full now. Raises
    NothingToTile.
    """
    grid = base.reference.grid
    lower = grid.lower(replaced)
    sights = [base.seen.sights and base.seen.sights.blinded(lower, lower + grid.size)]
    older = (without(load(), grid, replaced) for load in base.scans)
    scans = itertools.chain(older, watched((load() for load in seen), sights))
    fused = fused_scans(scans, len(base.scans) + len(seen), settings, progress)
    reference, tiles = tiled_map(fused, grid, (), settings, progress)
    return BuiltMap(
        reference=reference, tiles=tiles, outcomes=(), report=None, seen=Seen.of_voxels(fused, sights)
    )


def without(scan: RegisteredScan, grid: TileGrid, tiles: Indices) -> RegisteredScan:
    """Return the scan less its points in these tiles (T, 3)."""
    stays = grid.locate_among(scan.points, tiles) < 0
    colors = None if scan.colors is None else scan.colors[stays]
    return replace(scan, points=scan.points[stays], colors=colors)
