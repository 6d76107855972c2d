"""A training set: simulated buildings, each walked again and again, their tiles with further observations of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field
from scipy.ndimage import binary_dilation

from worker.cloud.poses import inverse, transformed
from worker.cloud.settings import StrictModel
from worker.cloud.tiling import TilePairs, Tiles, TilingSettings, cut, grid_over, pair_tiles
from worker.cloud.types import Bools, Matrix4, Points
from worker.cloud.voxels import Voxels, merged_in_order
from worker.processes import default_processes, open_processes
from worker.progress import Progress, no_progress
from worker.simulation.scenes import BUILDINGS, BuildingKind, Scene, rigid
from worker.simulation.sensor import SimulatedScan
from worker.simulation.truth import true_changes
from worker.simulation.visits import edited, visit
from worker.training.anomalies import OPERATIONS, ChangeSize
from worker.training.dataset import Observation, TileSet, joined

MARGIN = 1e-4  #: metres that a synthetic change keeps from the tile's border, which belongs to the next tile


class WalkSettings(StrictModel):
    """How each building is walked, and how well each scan of a visit is placed."""

    stops: dict[BuildingKind, int] = Field(
        {"office": 14, "corridor": 24, "room": 5}, description="scans of the first visit"
    )
    second_share: tuple[float, float] = Field(
        (0.35, 1.0), description="stops of a further visit as a share of the first's, drawn for each"
    )
    pose_error: tuple[float, float] = Field(
        (0.01, 0.15), description="sigma of each registered scan's shift in metres and yaw in degrees"
    )
    edited_visits: int = Field(3, ge=0, description="each after edits of its own")
    edits: dict[BuildingKind, int] = Field(
        {"office": 12, "corridor": 12, "room": 4},
        description="pieces added, removed, moved, in turn, before an edited visit",
    )
    rebuilds: int = Field(
        2, ge=0, description="maps fused anew from the first visit, a few of its scans changed"
    )
    rebuilt_scans: int = Field(3, ge=1, description="of a rebuild that are changed, at most a quarter")
    rebuilt_tiles: int = Field(8, ge=1, description="of each, at most half of those it sees well by itself")
    again_error: tuple[float, float] = Field(
        (0.002, 0.02),
        description="sigma of what a second registration of a scan differs by, metres and degrees; as measured",
    )
    magnitude: tuple[float, float] = Field((0.05, 0.50), description="metres, of a synthetic change")
    density: tuple[float, float] = Field((0.05, 0.50), description="share of the scan's points in the tile")
    voxel_size: float = Field(0.05, gt=0, description="metres")
    tiling: TilingSettings = TilingSettings.model_validate({})


class TrainingSetSettings(StrictModel):
    """Which buildings are walked."""

    offices: int = Field(14, ge=0, description="four rooms and a corridor each")
    corridors: int = Field(8, ge=0, description="L-shaped, about 170 tiles each")
    rooms: int = Field(50, ge=0, description="single furnished rooms")
    walks: WalkSettings = WalkSettings.model_validate({})
    seed: int = Field(1000, description="of the first building; keep test buildings apart from it")

    def kinds(self) -> list[BuildingKind]:
        """List the kind of every building, in the order of their seeds."""
        counts: dict[BuildingKind, int]
        counts = {"office": self.offices, "corridor": self.corridors, "room": self.rooms}
        return [kind for kind, count in counts.items() for _ in range(count)]


def build_training_set(
    settings: TrainingSetSettings, progress: Progress = no_progress, *, processes: int | None = None
) -> TileSet:
    """Walk every building, by default as many at a time as there are cores; the same set however many."""
    tasks = [
        (number, kind, settings.seed + number, settings.walks) for number, kind in enumerate(settings.kinds())
    ]
    walks: dict[int, TileSet] = {}
    with open_processes(min(processes or default_processes(), len(tasks))) as pool:
        for number, tiles in pool.map_unordered(_numbered_walk, tasks):
            walks[number] = tiles
            progress("build training set", len(walks) / len(tasks))
    source = f"simulated visits: {settings.model_dump_json()}"
    return joined([walks[number] for number in sorted(walks)], source=source)


def _numbered_walk(task: tuple[int, BuildingKind, int, WalkSettings]) -> tuple[int, TileSet]:
    number, kind, seed, settings = task
    return number, walk_building(kind, seed, settings)


def walk_building(kind: BuildingKind, seed: int, settings: WalkSettings) -> TileSet:
    """Take the tiles of one building that two honest visits saw well, with further observations of them.

    It stands at a random yaw in its map, as it does when the first scan sets the frame.
    """
    rng = np.random.default_rng((seed, 7))
    scene, map_from_world = BUILDINGS[kind](seed), rigid(yaw=float(rng.uniform(0, 360)))
    scans = visit(scene, settings.stops[kind], seed=10 * seed, prior_error=settings.pose_error)
    voxels = _voxels(scans, map_from_world, settings)
    points = merged_in_order(voxels).points
    grid = grid_over(points, tile_size=settings.tiling.tile_size, voxel_size=settings.voxel_size)
    walk = _Walk(
        kind=kind,
        seed=seed,
        scene=scene,
        map_from_world=map_from_world,
        scans=scans,
        voxels=tuple(voxels),
        tiles=cut(points, grid, min_points=settings.tiling.min_points),
        settings=settings,
        rng=rng,
    )
    _, matched = walk.again(scene, 10 * seed + 1)
    observations = [*_after_edits(walk), *_rebuilt(walk)]
    return _tile_set(matched, observations, settings)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Walk:
    """A building with its map, which further visits are compared with."""

    kind: BuildingKind
    seed: int
    scene: Scene
    map_from_world: Matrix4
    scans: tuple[SimulatedScan, ...]  #: of the first visit
    voxels: tuple[Voxels, ...]  #: each of these scans in the map frame, a point a voxel
    tiles: Tiles  #: of the map
    settings: WalkSettings
    rng: np.random.Generator

    def again(self, scene: Scene, seed: int) -> tuple[tuple[SimulatedScan, ...], TilePairs]:
        """Visit the building, as `scene` has it now, with a random number of stops; pair its tiles with the map's."""
        settings = self.settings
        count = max(1, round(settings.stops[self.kind] * self.rng.uniform(*settings.second_share)))
        scans = visit(scene, count, seed=seed, prior_error=settings.pose_error)
        current = merged_in_order(_voxels(scans, self.map_from_world, settings)).points
        return scans, pair_tiles(self.tiles, current, settings=settings.tiling)


def _voxels(scans: Sequence[SimulatedScan], map_from_world: Matrix4, settings: WalkSettings) -> list[Voxels]:
    """Move each scan to its prior, map frame, a point a voxel."""
    moved = (transformed(scan.points, map_from_world @ scan.prior).astype(np.float32) for scan in scans)
    return [Voxels.of(points, size=settings.voxel_size) for points in moved]


def _after_edits(walk: _Walk) -> Iterator[Observation]:
    """Visit after whole things were added, removed and moved: tiles that changed in sight, and those around them.

    A tile in which something changed out of sight, or too little to count, is neither changed nor unchanged.
    """
    for number in range(walk.settings.edited_visits):
        seed, after = 10 * walk.seed + 2 + number, walk.scene
        with suppress(ValueError):  # no edits leave a way: nothing is edited
            after, _ = edited(walk.scene, walk.settings.edits[walk.kind], seed=seed, count=1)
        scans, pairs = walk.again(after, seed)
        changed, still = _truth(walk, after, scans)
        for tile in np.flatnonzero(pairs.observed & (changed | still)).tolist():
            yield Observation(
                tile=tile, points=pairs.current[tile], changed=bool(changed[tile]), rebuilt=False
            )


def _truth(walk: _Walk, after: Scene, scans: Sequence[SimulatedScan]) -> tuple[Bools, Bools]:
    """Return (T,) tiles that changed in sight, and (T,) tiles beside those in which nothing changed at all."""
    grid, indices = walk.tiles.grid, walk.tiles.indices
    first, second = (
        [walk.map_from_world @ scan.world_from_sensor for scan in visit] for visit in (walk.scans, scans)
    )
    exists, visible = true_changes(
        walk.scene, after, grid, map_from_world=walk.map_from_world, first=first, second=second
    )
    near = binary_dilation(exists.changed, np.ones((3, 3, 3), bool))
    touched = exists.cells_of(indices).any(axis=1)
    beside: Bools = near.ravel()[grid.cells(indices)] & ~touched
    return visible.of(indices), beside


def _rebuilt(walk: _Walk) -> Iterator[Observation]:
    """Fuse the same visit anew, a few scans changed at a few tiles and registered again (paper, Section 4.2).

    A change ends at its tile's border, and the registration that follows it pushes some of its points across: the
    tile beside then shows a few points far off, and has not changed. Tiles that come out as they were are left out:
    that pair every tile makes with itself.
    """
    settings, tiles, rng = walk.settings, walk.tiles, walk.rng
    most = min(settings.rebuilt_scans, max(1, len(walk.scans) // 4))
    for _ in range(settings.rebuilds):
        rebuilt, injected = list(walk.voxels), np.zeros(len(tiles.points), bool)
        for scan in rng.choice(len(walk.scans), most, replace=False).tolist():
            pose = walk.map_from_world @ walk.scans[scan].prior
            points = transformed(walk.scans[scan].points, pose).astype(np.float32)
            for tile in _own_tiles(walk.voxels[scan], tiles, settings, rng):
                points = _injected(points, tiles, tile, settings, rng)
                injected[tile] = True
            again = _registered_again(points, pose, settings.again_error, rng)
            rebuilt[scan] = Voxels.of(again, size=settings.voxel_size)
        pairs = pair_tiles(tiles, merged_in_order(rebuilt).points, settings=settings.tiling)
        for tile in np.flatnonzero(pairs.observed).tolist():
            if not np.array_equal(pairs.current[tile], tiles.points[tile]):
                yield Observation(
                    tile=tile, points=pairs.current[tile], changed=bool(injected[tile]), rebuilt=True
                )


def _registered_again(
    points: Points, pose: Matrix4, error: tuple[float, float], rng: np.random.Generator
) -> Points:
    """Move a scan (n, 3), map frame, that was taken at `pose`, to where a second registration puts it."""
    metres, degrees = error
    off = rigid(*rng.normal(0.0, metres, 3), yaw=float(rng.normal(0.0, degrees)))
    about = rigid(*pose[:3, 3])
    moved: Points = transformed(points, about @ off @ inverse(about)).astype(np.float32)
    return moved


def _own_tiles(part: Voxels, tiles: Tiles, settings: WalkSettings, rng: np.random.Generator) -> list[int]:
    """Choose some of the tiles that the scan alone sees densely enough."""
    own = pair_tiles(
        tiles, part.points, settings=settings.tiling.model_copy(update={"min_observed_share": 0.0})
    )
    able = np.flatnonzero(own.observed)
    count = min(settings.rebuilt_tiles, len(able) // 2)
    return [int(tile) for tile in rng.choice(able, count, replace=False)]


def _injected(
    points: Points, tiles: Tiles, tile: int, settings: WalkSettings, rng: np.random.Generator
) -> Points:
    """Put a synthetic change into one tile of a scan (n, 3), map frame."""
    grid, index = tiles.grid, tiles.indices[[tile]]
    inside = grid.locate(points) == grid.cells(index)
    if not inside.any():
        return points
    centre, half = grid.centers(index)[0], (grid.size / 2 - MARGIN).astype(np.float32)
    change = ChangeSize(magnitude=rng.uniform(*settings.magnitude), density=rng.uniform(*settings.density))
    operation = OPERATIONS[str(rng.choice(list(OPERATIONS)))]
    after = operation((points[inside] - centre).astype(np.float32), change, half, rng).points
    return np.concatenate([points[~inside], (after + centre).astype(np.float32)])


def _tile_set(matched: TilePairs, observations: Sequence[Observation], settings: WalkSettings) -> TileSet:
    """Keep the tiles that the second visit saw well, each about its centre."""
    tiles = matched.reference
    centres = tiles.grid.centers(tiles.indices)

    def centred(points: Points, tile: int) -> Points:
        local: Points = (points - centres[tile]).astype(np.float32)
        return local

    return TileSet(
        points_a=tuple(centred(points, tile) for tile, points in enumerate(tiles.points)),
        points_b=tuple(centred(points, tile) for tile, points in enumerate(matched.current)),
        observations=tuple(
            replace(observation, points=centred(observation.points, observation.tile))
            for observation in observations
        ),
        centres=centres,
        buildings=np.zeros(len(centres), np.int32),
        tile_size=settings.tiling.tile_size,
        source="",
    ).subset(matched.observed)
