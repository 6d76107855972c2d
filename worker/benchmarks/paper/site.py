"""The place of the benchmark: a simulated corridor, walked once, its map and its tiles (paper, Section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.pcd import write_pcd
from worker.cloud.poses import transformed
from worker.cloud.tiling import TileGrid, Tiles, cut, grid_over
from worker.cloud.types import Matrix4, Points
from worker.cloud.voxels import Voxels, merged_in_order
from worker.pipeline.mapping.fusion import reference_map
from worker.pipeline.mapping.map_registration import register_map_scans
from worker.pipeline.registration.icp import Surface
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress
from worker.simulation.scenes import corridor
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import drifted_within, stops, visit

DRIFT = (0.25, 4.0)  #: metres over the floor and degrees of yaw; each prior is off by at most this


@dataclass(frozen=True, kw_only=True, slots=True)
class SiteSettings:
    """Which corridor, and how it is walked; the defaults are the paper's numbers."""

    seed: int = 1  #: of the building and the walk
    stops: int = 42  #: of the walk
    scans: int = 25  #: of the map, evenly along the walk
    true_poses: bool = False  #: scans stand where they were taken, and no registration is run
    duration_s: float = 5.0  #: of standing at each stop; about 20,000 points a second
    length: float = 20.0  #: metres of the corridor along x
    leg: float = 18.0  #: metres along y; 0 makes it straight


#: To see that everything runs: seconds, and no figures worth citing.
QUICK_SITE = SiteSettings(stops=8, scans=5, duration_s=3.0, length=9.0, leg=0.0)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Site:
    """A map and the scans that it was fused from."""

    name: str
    scans: tuple[Points, ...]  #: S arrays (n, 3) float32, metres, each in its own frame
    poses: tuple[Matrix4, ...]  #: S times map_from_scan
    voxels: tuple[Voxels, ...]  #: S times the scan in the map frame, a point a voxel
    tiles: Tiles  #: the stored reference
    dense: tuple[
        NDArray[np.intp], ...
    ]  #: S times the places in `tiles` in which the scan alone, a point a voxel, would make a tile
    points: Points  #: (M, 3) the map, for pictures
    surface: Surface | None  #: what a modified scan is registered to; None at true poses
    settings: PipelineSettings
    seed: int

    def placed(self, scan: int) -> Points:
        """(n, 3) float32, map frame."""
        return transformed(self.scans[scan], self.poses[scan]).astype(np.float32)


def build_site(settings: SiteSettings, pipeline: PipelineSettings, progress: Progress) -> Site:
    """Simulate the walk and build the map. Raises MapFailed where registration finds none."""
    progress("simulating", 0.0)
    scene = corridor(settings.seed, length=settings.length, leg=settings.leg)
    every = stops(scene, settings.stops, seed=settings.seed)
    chosen = np.linspace(0, len(every) - 1, min(settings.scans, len(every))).round().astype(int)
    seen = visit(
        scene,
        tuple(every[stop] for stop in chosen),
        seed=settings.seed,
        prior_error=DRIFT,
        drift=drifted_within,
        duration_s=settings.duration_s,
    )
    if settings.true_poses:
        placed = [(scan.points, scan.world_from_sensor) for scan in seen]
    else:
        placed = _registered(seen, pipeline, progress)
    return _mapped(scene.name, placed, settings, pipeline)


def _registered(
    seen: tuple[SimulatedScan, ...], pipeline: PipelineSettings, progress: Progress
) -> list[tuple[Points, Matrix4]]:
    """The accepted scans at the poses that map building finds from drifted priors."""
    with TemporaryDirectory(prefix="spicd-paper-") as folder:
        files = [
            ScanFile(name=f"scan-{number:02d}", path=Path(folder) / f"{number:02d}.pcd", pose=scan.prior)
            for number, scan in enumerate(seen)
        ]
        for file, scan in zip(files, seen, strict=True):
            write_pcd(file.path, scan.points)
        outcomes = register_map_scans(files, settings=pipeline.multi_scan, progress=progress).outcomes
    return [
        (scan.points, outcome.placement.map_from_scan)
        for scan, outcome in zip(seen, outcomes, strict=True)
        if outcome.placement
    ]


def _mapped(
    name: str, placed: list[tuple[Points, Matrix4]], settings: SiteSettings, pipeline: PipelineSettings
) -> Site:
    size = pipeline.registration.voxel_size
    there = [transformed(points, pose).astype(np.float32) for points, pose in placed]
    voxels = tuple(Voxels.of(points, size=size) for points in there)
    whole = merged_in_order(voxels)
    grid = grid_over(whole.points, tile_size=pipeline.tiling.tile_size, voxel_size=size)
    known = None
    if not settings.true_poses:
        known = reference_map(whole, grid=grid, settings=pipeline.registration).surface()
    tiles = cut(whole.points, grid, min_points=pipeline.tiling.min_points)
    return Site(
        name=name,
        scans=tuple(points for points, _ in placed),
        poses=tuple(pose for _, pose in placed),
        voxels=voxels,
        tiles=tiles,
        dense=tuple(_dense(part.points, tiles, pipeline.tiling.min_points) for part in voxels),
        points=whole.points,
        surface=known,
        settings=pipeline,
        seed=settings.seed,
    )


def tiles_of(points: Points, grid: TileGrid) -> NDArray[np.int64]:
    """(N,) flat cell of each point (N, 3), map frame; -1 outside the grid."""
    cells = np.floor((points - grid.origin) / grid.size).astype(np.int64)
    flat: NDArray[np.int64] = np.full(len(points), -1, np.int64)
    inside = np.all((cells >= grid.lowest) & (cells < np.add(grid.lowest, grid.shape)), axis=1)
    flat[inside] = flat_cells(cells[inside], grid)
    return flat


def flat_cells(cells: NDArray[np.int64], grid: TileGrid) -> NDArray[np.int64]:
    """(N, 3) tile indices within the grid -> (N,)"""
    place = (cells - np.array(grid.lowest)).T
    return np.asarray(np.ravel_multi_index(tuple(place), grid.shape), np.int64)


def _dense(points: Points, tiles: Tiles, least: int) -> NDArray[np.intp]:
    cells, counts = np.unique(tiles_of(points, tiles.grid), return_counts=True)
    wanted = flat_cells(tiles.indices.astype(np.int64), tiles.grid)
    return np.flatnonzero(np.isin(wanted, cells[counts >= least]))
