"""The method in order: scans to a map, and a survey to changes. Reads like the paper's Figure 1."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field

from worker.cloud.tiling import (
    TileGrid,
    TilePairs,
    Tiles,
    TilingSettings,
    cut,
    grid_over,
    grown,
    pair_tiles,
)
from worker.cloud.types import Arrays
from worker.cloud.voxels import Voxels
from worker.detectors.card import Preprocessing
from worker.detectors.detector import Detector
from worker.errors import MapFailed, RegistrationFailed
from worker.pipeline.mapping.fusion import CurrentMap, ReferenceMap, current_map, fuse, reference_map
from worker.pipeline.mapping.map_registration import MapReport, register_map_scans
from worker.pipeline.mapping.pair_registration import PairCache
from worker.pipeline.mapping.settings import JointRegistrationSettings, MapSettings
from worker.pipeline.mapping.survey_registration import register_survey_scans
from worker.pipeline.registration.results import RegisteredScan, ScanFile, ScanResult, read_registered
from worker.pipeline.registration.scan_to_scan import PairResult
from worker.pipeline.registration.settings import RegistrationSettings, with_values
from worker.pipeline.results.changes import ChangeSet, decide
from worker.progress import Progress, no_progress


class PipelineSettings(BaseModel):
    """One settings class a stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    registration: RegistrationSettings = Field(default_factory=RegistrationSettings)
    mapping: MapSettings = Field(default_factory=MapSettings)
    tiling: TilingSettings = Field(default_factory=TilingSettings)
    max_scan_points: int = Field(50_000_000, gt=0)

    def for_model(self, needs: Preprocessing) -> PipelineSettings:
        """The same settings with what is tied to a model's weights put in its place."""
        voxels = {"voxel_size": needs.voxel_size}
        tiles = {"tile_size": needs.tile_size, "min_points": needs.min_points}
        return with_values(
            self,
            registration=with_values(self.registration, **voxels),
            tiling=with_values(self.tiling, **tiles),
        )

    @property
    def joint_registration(self) -> JointRegistrationSettings:
        """What the registration of many scans needs of these."""
        return JointRegistrationSettings(
            registration=self.registration, mapping=self.mapping, max_points=self.max_scan_points
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class BuiltMap:
    """A reference map, tiled, with every scan's outcome."""

    reference: ReferenceMap
    tiles: Tiles
    outcomes: tuple[ScanResult, ...]  #: of the files, in their order
    report: MapReport | None  #: None where nothing was registered anew
    kept: tuple[PairResult, ...] = ()  #: the registrations that the map rests on
    rejected: tuple[PairResult, ...] = ()  #: accepted ones that loops do not close over


@dataclass(frozen=True, kw_only=True, slots=True)
class LocatedSurvey:
    """A survey in the map's frame, cut along the map's tiles."""

    current: CurrentMap
    pairs: TilePairs
    outcomes: tuple[ScanResult, ...]


class NoScanAccepted(RegistrationFailed):
    """Every scan of a survey was left out; `outcomes` says why, scan by scan."""

    def __init__(self, outcomes: Sequence[ScanResult]) -> None:
        self.outcomes = tuple(outcomes)
        reasons = "; ".join(str(outcome.reason) for outcome in outcomes)
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
    """Stage 1: place the scans in one frame, fuse them, cut the map into tiles.

    `pairs` keeps registered pairs, so that a build that was killed goes on; `processes` is one a core if None.
    Raises ScanError where no file can be read, MapFailed where no scan holds a pose, and NothingToTile.
    """
    registered = register_map_scans(
        files, settings=settings.joint_registration, pair_cache=pairs, processes=processes, progress=progress
    )
    fused = fused_scans(accepted_scans(files, registered.outcomes, settings), len(files), settings, progress)
    reference, tiles = tiled_map(fused, None, registered.outcomes, settings, progress)
    return BuiltMap(
        reference=reference,
        tiles=tiles,
        outcomes=registered.outcomes,
        report=registered.report,
        kept=registered.kept,
        rejected=registered.rejected,
    )


def locate_survey(
    files: Sequence[ScanFile],
    reference: ReferenceMap,
    tiles: Tiles,
    *,
    settings: PipelineSettings,
    progress: Progress = no_progress,
) -> LocatedSurvey:
    """Stage 3, first half: place the scans on the map, fuse those accepted, pair the tiles.

    Raises ScanError where no file can be read, NoScanAccepted where none is left to compare.
    """
    outcomes = register_survey_scans(
        files, reference.surface(), settings=settings.joint_registration, progress=progress
    )
    if not any(outcome.registration for outcome in outcomes):
        raise NoScanAccepted(outcomes)
    progress("tiling", 0.0)
    accepted = accepted_scans(files, outcomes, settings)
    current = current_map(accepted, voxel_size=reference.voxel_size)
    pairs = pair_tiles(tiles, current.points, settings=settings.tiling)
    progress("tiling", 1.0)
    return LocatedSurvey(current=current, pairs=pairs, outcomes=outcomes)


def detect(
    pairs: TilePairs,
    detector: Detector,
    *,
    description: Arrays | None = None,
    threshold: float | None = None,
    progress: Progress = no_progress,
) -> ChangeSet:
    """Stage 3, second half: score the tiles, then decide; the threshold is the card's if None is given."""
    scores = detector.score(pairs, description=description, progress=progress)
    return decide(pairs, scores, threshold=detector.card.threshold if threshold is None else threshold)


def accepted_scans(
    files: Sequence[ScanFile], outcomes: Sequence[ScanResult], settings: PipelineSettings
) -> Iterator[RegisteredScan]:
    """The points of each accepted scan, read again: no two scans are held at once."""
    for file, outcome in zip(files, outcomes, strict=True):
        if outcome.registration is not None:
            yield read_registered(file, outcome.registration, max_points=settings.max_scan_points)


def fused_scans(
    scans: Iterable[RegisteredScan], count: int, settings: PipelineSettings, progress: Progress
) -> Voxels:
    def told() -> Iterator[RegisteredScan]:
        for done, scan in enumerate(scans):
            progress("fusing", done / max(count, 1))
            yield scan
        progress("fusing", 1.0)

    return fuse(told(), voxel_size=settings.registration.voxel_size)


def tiled_map(
    fused: Voxels,
    grid: TileGrid | None,
    outcomes: Sequence[ScanResult],
    settings: PipelineSettings,
    progress: Progress,
) -> tuple[ReferenceMap, Tiles]:
    """The map with its normals, cut along a grid of its own or along one that there was."""
    progress("tiling", 0.0)
    reference = reference_map(fused, settings=settings.registration)
    if grid is None:
        grid = grid_over(reference.points, tile_size=settings.tiling.tile_size, voxel_size=fused.size)
    tiles = cut(reference.points, grown(grid, reference.points), min_points=settings.tiling.min_points)
    if not tiles.points:
        raise NothingToTile(outcomes, points=len(reference.points), min_points=settings.tiling.min_points)
    progress("tiling", 1.0)
    return reference, tiles
