"""The method in order: scans to a map, and a survey to changes. Reads like the paper's Figure 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field

from worker.detectors.card import Preprocessing
from worker.detectors.detector import Detector
from worker.errors import MapFailed, RegistrationFailed
from worker.pipeline.chaining import Outcome, ScanFile, chain, place
from worker.pipeline.changes import ChangeSet, decide
from worker.pipeline.mapping import CurrentMap, ReferenceMap, current_map, reference_map
from worker.pipeline.registration_settings import RegistrationSettings
from worker.pipeline.tiling import TilePairs, Tiles, TilingSettings, cut, grid_over, pair_tiles
from worker.pipeline.values import Arrays
from worker.progress import Progress, silent


class PipelineSettings(BaseModel):
    """One settings class a stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    registration: RegistrationSettings = Field(default_factory=RegistrationSettings)
    tiling: TilingSettings = Field(default_factory=TilingSettings)
    max_scan_points: int = Field(50_000_000, gt=0)

    def for_model(self, needs: Preprocessing) -> PipelineSettings:
        """The same settings with what is tied to a model's weights put in its place."""
        voxels = {"voxel_size": needs.voxel_size}
        tiles = {"tile_size": needs.tile_size, "min_points": needs.min_points}
        return self.model_copy(
            update={
                "registration": self.registration.model_copy(update=voxels),
                "tiling": self.tiling.model_copy(update=tiles),
            }
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class BuiltMap:
    """A reference map, tiled, with every scan's outcome."""

    reference: ReferenceMap
    tiles: Tiles
    outcomes: tuple[Outcome, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class LocatedSurvey:
    """A survey in the map's frame, cut along the map's tiles."""

    current: CurrentMap
    pairs: TilePairs
    outcomes: tuple[Outcome, ...]


class NoScanAccepted(RegistrationFailed):
    """Every scan of a survey was left out; `outcomes` says why, scan by scan."""

    def __init__(self, outcomes: Sequence[Outcome]) -> None:
        self.outcomes = tuple(outcomes)
        reasons = "; ".join(str(outcome.reason) for outcome in outcomes)
        super().__init__(f"no scan could be registered to the map: {reasons}")


class NothingToTile(MapFailed):
    """The fused map is too thin for a single tile; `outcomes` says what became of each scan."""

    def __init__(self, outcomes: Sequence[Outcome], *, points: int, min_points: int) -> None:
        self.outcomes = tuple(outcomes)
        super().__init__(
            f"no tile holds {min_points} points of the fused map ({points} points in all); add scans"
        )


def build_map(
    files: Sequence[ScanFile], *, settings: PipelineSettings, progress: Progress = silent
) -> BuiltMap:
    """Stage 1: place the scans in one frame, fuse them, cut the map into tiles.

    Raises ScanError for a file that cannot be read, MapFailed where no scan holds a pose, and NothingToTile.
    """
    outcomes, fused = chain(
        files, settings=settings.registration, max_points=settings.max_scan_points, progress=progress
    )
    progress("tiling", 0.0)
    reference = reference_map(fused, settings=settings.registration)
    grid = grid_over(reference.points, tile_size=settings.tiling.tile_size, voxel_size=fused.size)
    tiles = cut(reference.points, grid, min_points=settings.tiling.min_points)
    if not tiles.points:
        raise NothingToTile(outcomes, points=len(reference.points), min_points=settings.tiling.min_points)
    progress("tiling", 1.0)
    return BuiltMap(reference=reference, tiles=tiles, outcomes=outcomes)


def locate_survey(
    files: Sequence[ScanFile],
    reference: ReferenceMap,
    tiles: Tiles,
    *,
    settings: PipelineSettings,
    progress: Progress = silent,
) -> LocatedSurvey:
    """Stage 3, first half: register each scan to the map, fuse those accepted, pair the tiles.

    Raises ScanError for a file that cannot be read, NoScanAccepted where none is left to compare.
    """
    outcomes = _place_all(files, reference, settings, progress)
    accepted = [outcome.scan for outcome in outcomes if outcome.scan]
    if not accepted:
        raise NoScanAccepted(outcomes)
    progress("tiling", 0.0)
    current = current_map(accepted, voxel_size=reference.voxel_size)
    pairs = pair_tiles(tiles, current.points, settings=settings.tiling)
    progress("tiling", 1.0)
    return LocatedSurvey(current=current, pairs=pairs, outcomes=tuple(outcomes))


def detect(
    pairs: TilePairs,
    detector: Detector,
    *,
    description: Arrays | None = None,
    threshold: float | None = None,
    progress: Progress = silent,
) -> ChangeSet:
    """Stage 3, second half: score the tiles, then decide; the threshold is the card's if None is given."""
    scores = detector.score(pairs, description=description, progress=progress)
    return decide(pairs, scores, threshold=detector.card.threshold if threshold is None else threshold)


def _place_all(
    files: Sequence[ScanFile], reference: ReferenceMap, settings: PipelineSettings, progress: Progress
) -> list[Outcome]:
    target = reference.surface()
    outcomes = []
    for done, file in enumerate(files):

        def tick(share: float = done / len(files)) -> None:
            progress("registering", share)

        outcomes.append(
            place(
                file,
                target,
                settings=settings.registration,
                max_points=settings.max_scan_points,
                tick=tick,
            )
        )
    progress("registering", 1.0)
    return outcomes
