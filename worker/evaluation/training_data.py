"""Training tiles from simulated buildings: two independent visits to each, and a third one after edits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from worker.evaluation.scenes import Scene, corridor, random_edits, random_room, rigid, small_office
from worker.evaluation.sensor import SimulatedScan
from worker.evaluation.truth import KINDS, changed_tiles
from worker.evaluation.visits import stops, visit
from worker.pipeline.tiling import TilePairs, TilingSettings, cut, grid_over, pair_tiles
from worker.pipeline.values import Bools, Matrix4, Points
from worker.pipeline.voxels import Voxels
from worker.progress import Progress, silent
from worker.training.dataset import TileSet

Kind = Literal["office", "corridor", "room"]
DRAWS, ANOTHER = 20, 100_000_000  #: of edits, and between the seeds of two draws


class TrainingSetSettings(BaseModel):
    """Which buildings are walked, and how well each scan of a visit is placed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    offices: int = Field(10, ge=0, description="four rooms and a corridor each")
    corridors: int = Field(8, ge=0, description="L-shaped, about 170 tiles each")
    rooms: int = Field(30, ge=0, description="single furnished rooms")
    stops: dict[Kind, int] = Field(
        {"office": 14, "corridor": 24, "room": 5}, description="scans of the first visit"
    )
    edits: dict[Kind, int] = Field(
        {"office": 12, "corridor": 12, "room": 4},
        description="pieces added, removed, moved, in turn, before the third visit",
    )
    second_share: tuple[float, float] = Field(
        (0.35, 1.0), description="stops of a further visit as a share of the first's, drawn for each"
    )
    pose_error: tuple[float, float] = Field(
        (0.01, 0.15), description="sigma of each registered scan's shift in metres and yaw in degrees"
    )
    voxel_size: float = Field(0.05, gt=0, description="metres")
    tiling: TilingSettings = TilingSettings.model_validate({})
    seed: int = Field(1000, description="of the first building; keep test buildings apart from it")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Walks:
    """The three visits to one building, cut into the tiles of the first. T tiles."""

    unchanged: TilePairs  #: the first visit and the second
    edited: TilePairs  #: the first visit and the third
    changed: Bools  #: (T,) where the third could see a change

    @property
    def kept(self) -> Bools:
        """(T,) tiles that the second visit saw well."""
        return self.unchanged.observed


def build_training_set(settings: TrainingSetSettings, progress: Progress = silent) -> TileSet:
    """Walk every building three times, the third time edited, and keep the tiles that the first two visits saw well.

    A building stands at a random yaw in its map, as it does when the first scan sets the frame.
    """
    buildings = list(_buildings(settings))
    parts = []
    for number, (kind, make) in enumerate(buildings):
        progress("build training set", number / len(buildings))
        parts.append(_walks(make(settings.seed + number), settings, kind, settings.seed + number))
    progress("build training set", 1.0)
    return _gathered(parts, settings)


def _buildings(settings: TrainingSetSettings) -> Iterator[tuple[Kind, Callable[[int], Scene]]]:
    makers: dict[Kind, Callable[[int], Scene]] = {
        "office": small_office,
        "corridor": corridor,
        "room": random_room,
    }
    counts = {"office": settings.offices, "corridor": settings.corridors, "room": settings.rooms}
    for kind, make in makers.items():
        for _ in range(counts[kind]):
            yield kind, make


def _walks(scene: Scene, settings: TrainingSetSettings, kind: Kind, seed: int) -> Walks:
    rng = np.random.default_rng((seed, 7))
    map_from_world = rigid(yaw=float(rng.uniform(0, 360)))
    first = settings.stops[kind]
    second, third = (max(1, round(first * rng.uniform(*settings.second_share))) for _ in range(2))
    after = _edited(scene, settings.edits[kind], seed)
    seen = [
        visit(there, count, seed=10 * seed + number, prior_error=settings.pose_error)
        for number, (there, count) in enumerate(((scene, first), (scene, second), (after, third)))
    ]
    a, b, c = (fused(scans, map_from_world, voxel_size=settings.voxel_size) for scans in seen)
    grid = grid_over(a, tile_size=settings.tiling.tile_size, voxel_size=settings.voxel_size)
    tiles = cut(a, grid, min_points=settings.tiling.min_points)
    truth = changed_tiles(
        scene.placed(map_from_world),
        after.placed(map_from_world),
        grid,
        sensors_before=[map_from_world @ scan.world_from_sensor for scan in seen[0]],
        sensors_after=[map_from_world @ scan.world_from_sensor for scan in seen[2]],
    )
    return Walks(
        unchanged=pair_tiles(tiles, b, settings=settings.tiling),
        edited=pair_tiles(tiles, c, settings=settings.tiling),
        changed=truth.of(tiles.indices),
    )


def _edited(scene: Scene, edits: int, seed: int) -> Scene:
    """The building with whole things added, removed and moved; a robot still has a way through it."""
    for draw in range(DRAWS):
        kinds = [KINDS[number % len(KINDS)] for number in range(edits)]
        after = random_edits(scene, seed=10 * seed + draw * ANOTHER, kinds=kinds)[0]
        with suppress(ValueError):
            stops(after, 1, seed=seed)
            return after
    return scene


def fused(scans: tuple[SimulatedScan, ...], map_from_world: Matrix4, *, voxel_size: float) -> Points:
    """(M, 3) float32, map frame: all scans at their priors, one point a voxel."""
    voxels: Voxels | None = None
    for scan in scans:
        pose = map_from_world @ scan.prior
        placed = scan.points @ pose[:3, :3].T + pose[:3, 3]
        one = Voxels.of(placed, size=voxel_size)
        voxels = one if voxels is None else voxels.merged(one)
    if voxels is None:
        raise ValueError("a visit needs at least one scan")
    return voxels.points


def _gathered(parts: list[Walks], settings: TrainingSetSettings) -> TileSet:
    points: tuple[list[Points], ...] = ([], [], [])
    centres, buildings = [], []
    for building, walks in enumerate(parts):
        tiles = walks.unchanged.reference
        middle = tiles.grid.centers(tiles.indices)
        shown = walks.changed & walks.edited.observed
        for tile in np.flatnonzero(walks.kept).tolist():
            third = walks.edited.current[tile] if shown[tile] else np.empty((0, 3), np.float32)
            for look, seen in zip(
                points, (tiles.points[tile], walks.unchanged.current[tile], third), strict=True
            ):
                look.append((seen - middle[tile]).astype(np.float32))
            centres.append(middle[tile])
            buildings.append(building)
    return TileSet(
        points_a=tuple(points[0]),
        points_b=tuple(points[1]),
        points_c=tuple(points[2]),
        centres=np.array(centres).reshape(-1, 3),
        buildings=np.array(buildings, dtype=np.int32),
        tile_size=settings.tiling.tile_size,
        source=f"simulated visits: {settings.model_dump_json()}",
    )
