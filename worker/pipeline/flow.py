"""The method in order: scans to a map, and a survey to changes. Reads like the paper's Figure 1."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from worker.cloud.fusing import FusedCloud
from worker.cloud.seen import Seen
from worker.cloud.sight import Sights
from worker.cloud.tiling import TileGrid, Tiles, grid_over, grown, pair_tiles, touched_tiles
from worker.cloud.types import Arrays
from worker.detectors.comparison import Comparison, SeenScan, Side
from worker.detectors.detector import Detection, Detector
from worker.errors import MapFailed, RegistrationFailed
from worker.pipeline.mapping.fusion import CurrentMap, ReferenceMap, current_map, fuse, reference_map
from worker.pipeline.mapping.map_registration import MapReport, register_map_scans
from worker.pipeline.mapping.pair_registration import PairCache
from worker.pipeline.mapping.survey_registration import register_survey_scans
from worker.pipeline.placement.displacement import displaced_tiles
from worker.pipeline.registration.results import (
    RegisteredScan,
    ScanFile,
    ScanResult,
    SurveyPlacement,
    read_registered,
    with_carrier,
)
from worker.pipeline.registration.scan_to_scan import PairResult
from worker.pipeline.results.changes import ChangeSet, decide
from worker.pipeline.results.objects import change_objects
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

Scans = Sequence[Callable[[], SeenScan]]  #: each call loads one


@dataclass(frozen=True, kw_only=True, slots=True)
class BuiltMap:
    """A reference map, tiled, with every scan's outcome."""

    reference: ReferenceMap
    tiles: Tiles
    outcomes: tuple[ScanResult, ...]  #: of the files, in their order
    report: MapReport | None  #: None where nothing was registered anew
    seen: Seen  #: what its scans saw, to compare surveys with
    kept: tuple[PairResult, ...] = ()  #: the registrations that the map rests on
    rejected: tuple[PairResult, ...] = ()  #: accepted ones that loops do not close over


@dataclass(frozen=True, kw_only=True, slots=True)
class LocatedSurvey:
    """A survey in the map's frame, beside the map."""

    current: CurrentMap
    comparison: Comparison
    outcomes: tuple[ScanResult, ...]
    placement: SurveyPlacement
    seen: Seen  #: what its scans saw


class NoScanAccepted(RegistrationFailed):
    """Every scan of a survey was left out; `outcomes` says why, scan by scan."""

    def __init__(self, outcomes: Sequence[ScanResult]) -> None:
        self.outcomes = tuple(outcomes)
        told = [outcome.diagnosis for outcome in outcomes if outcome.diagnosis is not None]
        reasons = "; ".join(f"{diagnosis.detail} [{diagnosis.reason}]" for diagnosis in told)
        super().__init__(f"no scan could be registered to the map: {reasons}")


class NothingToTile(MapFailed):
    """The fused map is too thin for a single tile; `outcomes` says what became of each scan."""

    def __init__(self, outcomes: Sequence[ScanResult], *, points: int, min_points: int) -> None:
        self.outcomes = tuple(outcomes)
        super().__init__(
            f"no tile holds {min_points} points of the fused map ({points} points in all); add scans"
        )


def build_map(
    files: Sequence[ScanFile],
    *,
    settings: PipelineSettings,
    pairs: PairCache | None = None,
    processes: int | None = None,
    progress: Progress = no_progress,
) -> BuiltMap:
    """Register the scans in one frame, fuse them, cut the map into tiles (stage 1).

    `pairs` keeps registered pairs, so that a build that was killed goes on; `processes` is one a core if None.
    Raises ScanError where no file can be read, MapFailed where no scan holds a pose, and NothingToTile.
    """
    files = with_carrier(files, settings.carrier, max_points=settings.max_scan_points)
    registered = register_map_scans(
        files, settings=settings.joint_registration, pair_cache=pairs, processes=processes, progress=progress
    )
    sights: list[Sights | None] = []
    scans = watched(accepted_scans(files, registered.outcomes, settings), sights)
    fused = fused_scans(scans, len(files), settings, progress)
    reference, tiles = tiled_map(fused, None, registered.outcomes, settings, progress)
    return BuiltMap(
        reference=reference,
        tiles=tiles,
        outcomes=registered.outcomes,
        report=registered.report,
        seen=Seen.of_voxels(fused, sights),
        kept=registered.kept,
        rejected=registered.rejected,
    )


def locate_survey(
    files: Sequence[ScanFile],
    reference: ReferenceMap,
    *,
    settings: PipelineSettings,
    reference_seen: Seen | None = None,
    progress: Progress = no_progress,
) -> LocatedSurvey:
    """Register the scans to the map, fuse those accepted, set both side by side (stage 3, first half).

    `reference_seen` is what the map's scans saw: poses are held against it, and detectors by voxels need it. Raises
    ScanError where no file can be read, NoScanAccepted where none is left to compare.
    """
    files = with_carrier(files, settings.carrier, max_points=settings.max_scan_points)
    registered = register_survey_scans(
        files,
        reference.surface(),
        settings=settings.joint_registration,
        sights=None if reference_seen is None else reference_seen.sights,
        progress=progress,
    )
    outcomes = registered.outcomes
    if not any(outcome.registration for outcome in outcomes):
        raise NoScanAccepted(outcomes)
    progress("tiling", 0.0)
    sights: list[Sights | None] = []
    accepted = watched(accepted_scans(files, outcomes, settings), sights)
    fused = fuse(accepted, voxel_size=reference.voxel_size, memory_bytes=settings.memory_bytes)
    displaced = displaced_tiles(registered.held, reference.grid)
    current, seen = replace(current_map(fused), displaced=displaced), Seen.of_voxels(fused, sights)
    comparison = compare(
        reference, current, settings=settings, reference_seen=reference_seen, current_seen=seen
    )
    progress("tiling", 1.0)
    return LocatedSurvey(
        current=current,
        comparison=comparison,
        outcomes=outcomes,
        placement=registered.placement,
        seen=seen,
    )


def compare(
    reference: ReferenceMap,
    current: CurrentMap,
    *,
    settings: PipelineSettings,
    reference_scans: Scans = (),
    current_scans: Scans = (),
    reference_seen: Seen | None = None,
    current_seen: Seen | None = None,
) -> Comparison:
    """Set the map and a survey side by side for a detector, cut along the map's tiles (about 50 ms)."""
    if settings.tiling.tiles == "touched":
        tiles = touched_tiles(reference.points, current.points, reference.grid)
    else:
        tiles = reference.tiles(min_points=settings.tiling.min_points)
    return Comparison(
        reference=Side(
            points=reference.points, normals=reference.normals, scans=reference_scans, seen=reference_seen
        ),
        current=Side(points=current.points, scans=current_scans, seen=current_seen),
        tile_pairs=pair_tiles(tiles, current.points, settings=settings.tiling),
        displaced=current.displaced,
    )


def detect(
    comparison: Comparison,
    detector: Detector,
    *,
    embedding: Arrays | None = None,
    threshold: float | None = None,
    settings: PipelineSettings | None = None,
    placement: SurveyPlacement | None = None,
    progress: Progress = no_progress,
) -> ChangeSet:
    """Score the survey, then decide (stage 3, second half); the threshold is the card's if None is given.

    `placement` is what `locate_survey` says of it; None where it is known.
    """
    settings = settings or PipelineSettings()
    detection = detector.detect(comparison, embedding=embedding, progress=progress)
    own = threshold is None
    threshold = detector.card.threshold if threshold is None else threshold
    return concluded(
        comparison, detection, threshold=threshold, settings=settings, placement=placement, by_objects=own
    )


def concluded(
    comparison: Comparison,
    detection: Detection,
    *,
    threshold: float,
    settings: PipelineSettings,
    placement: SurveyPlacement | None = None,
    by_objects: bool = True,
) -> ChangeSet:
    """Make of a detector's scores the states of tiles and, where it scored voxels that both visits saw, objects.

    Where the placement is in doubt, scores prove nothing: no tile is unchanged or changed, and there are no objects.
    The same is said of single tiles in which walls, floor or ceiling do not lie on the map's.
    """
    least = settings.tiling.min_observed_share
    changes = decide(comparison.tile_pairs, detection, threshold=threshold, min_observed_share=least)
    if placement is not None and placement.in_doubt:
        return changes.in_doubt(placement.confidence or 0.0)
    displaced = np.empty((0, 3), np.int32) if comparison.displaced is None else comparison.displaced
    if detection.voxels is None or comparison.reference.seen is None or comparison.current.seen is None:
        return changes.with_displaced(displaced)
    objects = change_objects(comparison, detection.voxels, settings.objects)
    changes = replace(changes, voxels=detection.voxels, objects=objects)
    changes = changes.where_objects_lie(least) if by_objects else changes
    return changes.with_displaced(displaced)


def accepted_scans(
    files: Sequence[ScanFile], outcomes: Sequence[ScanResult], settings: PipelineSettings
) -> Iterator[RegisteredScan]:
    """Read the points of each accepted scan again: no two scans are held at once."""
    for file, outcome in zip(files, outcomes, strict=True):
        if outcome.registration is not None:
            yield read_registered(file, outcome.registration, max_points=settings.max_scan_points)


def watched(scans: Iterable[RegisteredScan], sights: list[Sights | None]) -> Iterator[RegisteredScan]:
    """Yield the scans, and put the range image of each into `sights`; None where its sensor's place is not known."""
    for scan in scans:
        origin = scan.sensor_origin
        sights.append(None if origin is None else Sights.of([(scan.points, origin)]))
        yield scan


def fused_scans(
    scans: Iterable[RegisteredScan], count: int, settings: PipelineSettings, progress: Progress
) -> FusedCloud:
    """Fuse the scans, of which there are about `count`."""

    def reported() -> Iterator[RegisteredScan]:
        for done, scan in enumerate(scans):
            progress("fusing", done / max(count, 1))
            yield scan
        progress("fusing", 1.0)

    return fuse(reported(), voxel_size=settings.registration.voxel_size, memory_bytes=settings.memory_bytes)


def tiled_map(
    fused: FusedCloud,
    grid: TileGrid | None,
    outcomes: Sequence[ScanResult],
    settings: PipelineSettings,
    progress: Progress,
) -> tuple[ReferenceMap, Tiles]:
    """Return the map with its normals, cut along a grid of its own or along one that there was."""
    progress("tiling", 0.0)
    points = fused.points
    if grid is None:
        grid = grid_over(points, tile_size=settings.tiling.tile_size, voxel_size=fused.size)
    grid = grown(grid, points)
    reference = reference_map(fused, grid=grid, settings=settings.registration)
    tiles = reference.tiles(min_points=settings.tiling.min_points)
    if not tiles.points:
        raise NothingToTile(outcomes, points=len(reference.points), min_points=settings.tiling.min_points)
    progress("tiling", 1.0)
    return reference, tiles
