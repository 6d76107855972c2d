"""One simulated building, walked again and again: what a training set takes of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import binary_dilation

from worker.cloud.poses import inverse, transformed
from worker.cloud.tiling import TilePairs, Tiles, TilingSettings, cut, grid_over, pair_tiles
from worker.cloud.types import Bools, Matrix4, Points
from worker.cloud.voxels import Voxels, merged_in_order
from worker.processes import default_processes, open_processes
from worker.progress import Progress, no_progress
from worker.simulation.scenes import Scene, corridor, random_edits, random_room, rigid, small_office
from worker.simulation.sensor import SimulatedScan
from worker.simulation.truth import KINDS, TileTruth, changed_tiles
from worker.simulation.visits import stops, visit
from worker.training.anomalies import OPERATIONS, Change
from worker.training.dataset import Observation, TileSet, joined

Kind = Literal["office", "corridor", "room"]
MAKERS: Mapping[Kind, Callable[[int], Scene]] = {
    "office": small_office,
    "corridor": corridor,
    "room": random_room,
}
DRAWS, ANOTHER = 20, 100_000_000  #: of edits, and between the seeds of two draws
MARGIN = 1e-4  #: metres that a synthetic change keeps from the tile's border, which belongs to the next tile


class WalkSettings(BaseModel):
    """How each building is walked, and how well each scan of a visit is placed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    stops: dict[Kind, int] = Field(
        {"office": 14, "corridor": 24, "room": 5}, description="scans of the first visit"
    )
    second_share: tuple[float, float] = Field(
        (0.35, 1.0), description="stops of a further visit as a share of the first's, drawn for each"
    )
    pose_error: tuple[float, float] = Field(
        (0.01, 0.15), description="sigma of each registered scan's shift in metres and yaw in degrees"
    )
    edited_visits: int = Field(3, ge=0, description="each after edits of its own")
    edits: dict[Kind, int] = Field(
        {"office": 12, "corridor": 12, "room": 4},
        description="pieces added, removed, moved, in turn, before an edited visit",
    )
    rebuilds: int = Field(
        2, ge=0, description="maps fused anew from the first visit, a few of its scans changed"
    )
    rebuilt_scans: int = Field(3, ge=1, description="of a rebuild that are changed, at most a quarter")
    rebuilt_tiles: int = Field(8, ge=1, description="of each, at most half of those it sees well by itself")
    again_error: tuple[float, float] = Field(
        (0.003, 0.05),
        description="sigma of what a second registration of a scan differs by, metres and degrees",
    )
    magnitude: tuple[float, float] = Field((0.05, 0.50), description="metres, of a synthetic change")
    density: tuple[float, float] = Field((0.05, 0.50), description="share of the scan's points in the tile")
    voxel_size: float = Field(0.05, gt=0, description="metres")
    tiling: TilingSettings = TilingSettings.model_validate({})


def walked(kind: Kind, seed: int, settings: WalkSettings) -> TileSet:
    """The tiles of one building that two honest visits saw well, with further observations of them.

    It stands at a random yaw in its map, as it does when the first scan sets the frame.
    """
    rng = np.random.default_rng((seed, 7))
    scene, map_from_world = MAKERS[kind](seed), rigid(yaw=float(rng.uniform(0, 360)))
    scans = _visit(scene, settings.stops[kind], 10 * seed, settings)
    parts = _voxels(scans, map_from_world, settings)
    a = merged_in_order(parts).points
    grid = grid_over(a, tile_size=settings.tiling.tile_size, voxel_size=settings.voxel_size)
    tiles = cut(a, grid, min_points=settings.tiling.min_points)
    second = _visit(scene, _fewer(kind, settings, rng), 10 * seed + 1, settings)
    again = pair_tiles(
        tiles, merged_in_order(_voxels(second, map_from_world, settings)).points, settings=settings.tiling
    )
    observations = [
        *_edited_observations(scene, scans, tiles, map_from_world, settings, (kind, seed), rng),
        *_rebuilt_observations(scans, parts, tiles, map_from_world, settings, rng),
    ]
    return _set(again, observations, settings)


def _fewer(kind: Kind, settings: WalkSettings, rng: np.random.Generator) -> int:
    """Stops of a further visit."""
    return max(1, round(settings.stops[kind] * rng.uniform(*settings.second_share)))


def _visit(scene: Scene, count: int, seed: int, settings: WalkSettings) -> tuple[SimulatedScan, ...]:
    return visit(scene, count, seed=seed, prior_error=settings.pose_error)


def _voxels(scans: Sequence[SimulatedScan], map_from_world: Matrix4, settings: WalkSettings) -> list[Voxels]:
    """Each scan at its prior, map frame, a point a voxel."""
    placed = (transformed(scan.points, map_from_world @ scan.prior).astype(np.float32) for scan in scans)
    return [Voxels.of(points, size=settings.voxel_size) for points in placed]


def _edited_observations(
    scene: Scene,
    before: Sequence[SimulatedScan],
    tiles: Tiles,
    map_from_world: Matrix4,
    settings: WalkSettings,
    building: tuple[Kind, int],
    rng: np.random.Generator,
) -> Iterator[Observation]:
    """Visits after whole things were added, removed and moved: tiles that changed in sight, and those around them.

    A tile in which something changed out of sight, or too little to count, is neither changed nor unchanged.
    """
    kind, seed = building
    for number in range(settings.edited_visits):
        own = 10 * seed + 2 + number
        after = _edited(scene, settings.edits[kind], own)
        scans = _visit(after, _fewer(kind, settings, rng), own, settings)
        current = merged_in_order(_voxels(scans, map_from_world, settings)).points
        pairs = pair_tiles(tiles, current, settings=settings.tiling)
        changed, still = _truth((scene, after), (before, scans), tiles, map_from_world)
        for tile in np.flatnonzero(pairs.observed & (changed | still)).tolist():
            yield Observation(
                tile=tile, points=pairs.current[tile], changed=bool(changed[tile]), rebuilt=False
            )


def _edited(scene: Scene, edits: int, seed: int) -> Scene:
    """The building with whole things added, removed and moved; a robot still has a way through it."""
    kinds = [KINDS[number % len(KINDS)] for number in range(edits)]
    for draw in range(DRAWS):
        after = random_edits(scene, seed=seed + draw * ANOTHER, kinds=kinds)[0]
        with suppress(ValueError):
            stops(after, 1, seed=seed)
            return after
    return scene


def _truth(
    scenes: tuple[Scene, Scene],
    visits: tuple[Sequence[SimulatedScan], Sequence[SimulatedScan]],
    tiles: Tiles,
    map_from_world: Matrix4,
) -> tuple[Bools, Bools]:
    """(T,) tiles that changed in sight, and (T,) tiles beside those in which nothing changed at all."""
    old, new = (scene.placed(map_from_world) for scene in scenes)
    sensors = [[map_from_world @ scan.world_from_sensor for scan in scans] for scans in visits]
    exists = changed_tiles(old, new, tiles.grid)
    seen = changed_tiles(old, new, tiles.grid, sensors_before=sensors[0], sensors_after=sensors[1])
    near = binary_dilation(exists.changed, np.ones((3, 3, 3), bool))
    still = TileTruth(grid=tiles.grid, cells=exists.cells, min_cells=1).of(tiles.indices)
    beside: Bools = near[tuple(tiles.indices.T)] & ~still
    return seen.of(tiles.indices), beside


def _rebuilt_observations(
    scans: Sequence[SimulatedScan],
    parts: Sequence[Voxels],
    tiles: Tiles,
    map_from_world: Matrix4,
    settings: WalkSettings,
    rng: np.random.Generator,
) -> Iterator[Observation]:
    """The same visit fused anew, a few scans registered again and changed at a few tiles (paper, Section 4.2).

    Tiles that come out as they were are left out: that pair every tile makes with itself.
    """
    most = min(settings.rebuilt_scans, max(1, len(scans) // 4))
    for _ in range(settings.rebuilds):
        rebuilt, injected = list(parts), np.zeros(len(tiles.points), bool)
        for scan in rng.choice(len(scans), most, replace=False).tolist():
            placed = _again(scans[scan], map_from_world, settings.again_error, rng)
            for tile in _own_tiles(parts[scan], tiles, settings, rng):
                placed = _injected(placed, tiles, tile, settings, rng)
                injected[tile] = True
            rebuilt[scan] = Voxels.of(placed, size=settings.voxel_size)
        pairs = pair_tiles(tiles, merged_in_order(rebuilt).points, settings=settings.tiling)
        for tile in np.flatnonzero(pairs.observed).tolist():
            if not np.array_equal(pairs.current[tile], tiles.points[tile]):
                yield Observation(
                    tile=tile, points=pairs.current[tile], changed=bool(injected[tile]), rebuilt=True
                )


def _again(
    scan: SimulatedScan, map_from_world: Matrix4, error: tuple[float, float], rng: np.random.Generator
) -> Points:
    """(n, 3) map frame, where a second registration puts the scan."""
    metres, degrees = error
    pose = map_from_world @ scan.prior
    off = rigid(*rng.normal(0.0, metres, 3), yaw=float(rng.normal(0.0, degrees)))
    about = rigid(*pose[:3, 3])
    moved: Points = transformed(scan.points, about @ off @ inverse(about) @ pose).astype(np.float32)
    return moved


def _own_tiles(part: Voxels, tiles: Tiles, settings: WalkSettings, rng: np.random.Generator) -> list[int]:
    """Some of the tiles that the scan alone sees densely enough."""
    own = pair_tiles(
        tiles, part.points, settings=settings.tiling.model_copy(update={"min_observed_share": 0.0})
    )
    able = np.flatnonzero(own.observed)
    count = min(settings.rebuilt_tiles, len(able) // 2)
    return [int(tile) for tile in rng.choice(able, count, replace=False)]


def _injected(
    points: Points, tiles: Tiles, tile: int, settings: WalkSettings, rng: np.random.Generator
) -> Points:
    """The scan (n, 3), map frame, with a synthetic change in one tile."""
    grid = tiles.grid
    lower = grid.lower(tiles.indices[tile])
    inside = np.all((points >= lower) & (points < lower + grid.size), axis=1)
    if not inside.any():
        return points
    centre, half = lower + grid.size / 2, (grid.size / 2 - MARGIN).astype(np.float32)
    change = Change(magnitude=rng.uniform(*settings.magnitude), density=rng.uniform(*settings.density))
    operation = OPERATIONS[str(rng.choice(list(OPERATIONS)))]
    after = operation((points[inside] - centre).astype(np.float32), change, half, rng).points
    return np.concatenate([points[~inside], (after + centre).astype(np.float32)])


def _set(again: TilePairs, observations: Sequence[Observation], settings: WalkSettings) -> TileSet:
    """Of the tiles that the second visit saw well, each about its centre."""
    tiles = again.reference
    middle = tiles.grid.centers(tiles.indices)

    def about(points: Points, tile: int) -> Points:
        local: Points = (points - middle[tile]).astype(np.float32)
        return local

    every = range(len(tiles.points))
    return TileSet(
        points_a=tuple(about(tiles.points[tile], tile) for tile in every),
        points_b=tuple(about(again.current[tile], tile) for tile in every),
        observations=tuple(
            Observation(
                tile=observation.tile,
                points=about(observation.points, observation.tile),
                changed=observation.changed,
                rebuilt=observation.rebuilt,
            )
            for observation in observations
        ),
        centres=middle,
        buildings=np.zeros(len(middle), np.int32),
        tile_size=settings.tiling.tile_size,
        source="",
    ).subset(again.observed)


class TrainingSetSettings(BaseModel):
    """Which buildings are walked."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    offices: int = Field(14, ge=0, description="four rooms and a corridor each")
    corridors: int = Field(8, ge=0, description="L-shaped, about 170 tiles each")
    rooms: int = Field(50, ge=0, description="single furnished rooms")
    walks: WalkSettings = WalkSettings.model_validate({})
    seed: int = Field(1000, description="of the first building; keep test buildings apart from it")


def build_training_set(
    settings: TrainingSetSettings, progress: Progress = no_progress, *, processes: int | None = None
) -> TileSet:
    """Walk every building, by default as many at a time as there are cores; the same set however many."""
    tasks = [
        (number, kind, settings.seed + number, settings.walks) for number, kind in enumerate(_kinds(settings))
    ]
    found: dict[int, TileSet] = {}
    with open_processes(min(processes or default_processes(), len(tasks))) as pool:
        for number, part in pool.each(_walked, tasks):
            found[number] = part
            progress("build training set", len(found) / len(tasks))
    source = f"simulated visits: {settings.model_dump_json()}"
    return joined([found[number] for number in sorted(found)], source=source)


def _kinds(settings: TrainingSetSettings) -> Iterator[Kind]:
    counts: dict[Kind, int] = {
        "office": settings.offices,
        "corridor": settings.corridors,
        "room": settings.rooms,
    }
    for kind, count in counts.items():
        yield from itertools.repeat(kind, count)


def _walked(task: tuple[int, Kind, int, WalkSettings]) -> tuple[int, TileSet]:
    number, kind, seed, settings = task
    return number, walked(kind, seed, settings)
