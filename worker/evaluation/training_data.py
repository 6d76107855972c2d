"""Training tiles from simulated buildings: two independent visits to each, nothing changed in between."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from worker.evaluation.scenes import Scene, corridor, random_room, rigid, small_office
from worker.evaluation.sensor import SimulatedScan
from worker.evaluation.visits import visit
from worker.pipeline.tiling import TilePairs, TilingSettings, cut, grid_over, pair_tiles
from worker.pipeline.values import Matrix4, Points
from worker.pipeline.voxels import Voxels
from worker.progress import Progress, silent
from worker.training.dataset import TileSet


class TrainingSetSettings(BaseModel):
    """Which buildings are walked, and how well each scan of a visit is placed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    offices: int = Field(6, ge=0, description="four rooms and a corridor each")
    corridors: int = Field(5, ge=0, description="L-shaped, about 170 tiles each")
    rooms: int = Field(16, ge=0, description="single furnished rooms")
    stops: dict[str, int] = Field(
        {"office": 14, "corridor": 24, "room": 5}, description="scans of the first visit"
    )
    second_share: tuple[float, float] = Field(
        (0.5, 1.0), description="stops of the second visit as a share of the first's, drawn for each building"
    )
    pose_error: tuple[float, float] = Field(
        (0.01, 0.15), description="sigma of each registered scan's shift in metres and yaw in degrees"
    )
    voxel_size: float = Field(0.05, gt=0, description="metres")
    tiling: TilingSettings = TilingSettings.model_validate({})
    seed: int = Field(1000, description="of the first building; keep test buildings apart from it")


def build_training_set(settings: TrainingSetSettings, progress: Progress = silent) -> TileSet:
    """Walk every building twice and keep the tiles that both visits saw well.

    A building stands at a random yaw in its map, as it does when the first scan sets the frame.
    """
    buildings = list(_buildings(settings))
    parts: list[tuple[TilePairs, NDArray[np.bool_]]] = []
    for number, (kind, make) in enumerate(buildings):
        progress("build training set", number / len(buildings))
        pairs = _two_visits(make(settings.seed + number), settings, kind, settings.seed + number)
        parts.append((pairs, pairs.observed))
    progress("build training set", 1.0)
    return _gathered(parts, settings)


def _buildings(settings: TrainingSetSettings) -> Iterator[tuple[str, Callable[[int], Scene]]]:
    makers: dict[str, Callable[[int], Scene]] = {
        "office": small_office,
        "corridor": corridor,
        "room": random_room,
    }
    counts = {"office": settings.offices, "corridor": settings.corridors, "room": settings.rooms}
    for kind, count in counts.items():
        for _ in range(count):
            yield kind, makers[kind]


def _two_visits(scene: Scene, settings: TrainingSetSettings, kind: str, seed: int) -> TilePairs:
    rng = np.random.default_rng((seed, 7))
    map_from_world = rigid(yaw=float(rng.uniform(0, 360)))
    first = settings.stops[kind]
    second = max(1, round(first * rng.uniform(*settings.second_share)))
    seen = [
        visit(scene, count, seed=10 * seed + number, prior_error=settings.pose_error)
        for number, count in enumerate((first, second))
    ]
    a, b = (fused(scans, map_from_world, voxel_size=settings.voxel_size) for scans in seen)
    grid = grid_over(a, tile_size=settings.tiling.tile_size, voxel_size=settings.voxel_size)
    tiles = cut(a, grid, min_points=settings.tiling.min_points)
    return pair_tiles(tiles, b, settings=settings.tiling)


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


def _gathered(parts: list[tuple[TilePairs, NDArray[np.bool_]]], settings: TrainingSetSettings) -> TileSet:
    points_a, points_b, centres, buildings = [], [], [], []
    for building, (pairs, kept) in enumerate(parts):
        middle = pairs.reference.grid.centers(pairs.reference.indices)
        for tile in np.flatnonzero(kept).tolist():
            points_a.append((pairs.reference.points[tile] - middle[tile]).astype(np.float32))
            points_b.append((pairs.current[tile] - middle[tile]).astype(np.float32))
            centres.append(middle[tile])
            buildings.append(building)
    return TileSet(
        points_a=tuple(points_a),
        points_b=tuple(points_b),
        centres=np.array(centres).reshape(-1, 3),
        buildings=np.array(buildings, dtype=np.int32),
        tile_size=settings.tiling.tile_size,
        source=f"simulated visits: {settings.model_dump_json()}",
    )
