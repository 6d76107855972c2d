"""The place of the benchmark: a simulated corridor, walked once, its map and its tiles (paper, Section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.trajectory import scan_files
from worker.cloud.fusing import FusedCloud
from worker.cloud.poses import transformed
from worker.cloud.tiling import Tiles, cut, grid_over
from worker.cloud.types import Matrix4, Points
from worker.cloud.voxels import Voxels, merged_in_order
from worker.pipeline.mapping.fusion import reference_map
from worker.pipeline.mapping.map_registration import register_map_scans
from worker.pipeline.registration.surface import Surface
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress
from worker.simulation.scenes import corridor
from worker.simulation.visits import DRIFT, drifted_within, stops, visit


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
    #: S times the places in `tiles` in which the scan alone, a point a voxel, would make a tile
    dense: tuple[NDArray[np.intp], ...]
    points: Points  #: (M, 3) the map, for pictures
    surface: Surface | None  #: what a modified scan is registered to; None at true poses
    settings: PipelineSettings
    seed: int

    def placed(self, scan: int) -> Points:
        """Return the points of a scan in the map frame, (n, 3) float32."""
        return transformed(self.scans[scan], self.poses[scan]).astype(np.float32)


def build_site(settings: SiteSettings, pipeline: PipelineSettings, progress: Progress) -> Site:
    """Simulate the walk and build the map. Raises MapFailed where registration finds none."""
    progress("simulating", 0.0)
    scene = corridor(settings.seed, length=settings.length, leg=settings.leg)
    every = stops(scene, settings.stops, seed=settings.seed)
    chosen = np.linspace(0, len(every) - 1, min(settings.scans, len(every))).round().astype(int)
    with TemporaryDirectory(prefix="spicd-paper-") as folder:
        scans = visit(
            scene,
            tuple(every[stop] for stop in chosen),
            seed=settings.seed,
            prior_error=DRIFT,
            drift=drifted_within,
            duration_s=settings.duration_s,
            folder=Path(folder),
        )
        if settings.true_poses:
            return _mapped(scene.name, [(s.points, s.world_from_sensor) for s in scans], settings, pipeline)
        files = scan_files(scans)
        outcomes = register_map_scans(files, settings=pipeline.joint_registration, progress=progress).outcomes
    accepted = [
        (scan.points, outcome.registration.map_from_scan)
        for scan, outcome in zip(scans, outcomes, strict=True)
        if outcome.registration
    ]
    return _mapped(scene.name, accepted, settings, pipeline)


def _mapped(
    name: str, scans: Sequence[tuple[Points, Matrix4]], settings: SiteSettings, pipeline: PipelineSettings
) -> Site:
    """Fuse the scans (n, 3), each with its map_from_scan, and cut the map into tiles."""
    size = pipeline.registration.voxel_size
    clouds = [transformed(points, pose).astype(np.float32) for points, pose in scans]
    voxels = tuple(Voxels.of(points, size=size) for points in clouds)
    whole = FusedCloud.of(merged_in_order(voxels))
    grid = grid_over(whole.points, tile_size=pipeline.tiling.tile_size, voxel_size=size)
    tiles = cut(whole.points, grid, min_points=pipeline.tiling.min_points)
    reference = (
        None if settings.true_poses else reference_map(whole, grid=grid, settings=pipeline.registration)
    )
    return Site(
        name=name,
        scans=tuple(points for points, _ in scans),
        poses=tuple(pose for _, pose in scans),
        voxels=voxels,
        tiles=tiles,
        dense=tuple(_dense(part.points, tiles, pipeline.tiling.min_points) for part in voxels),
        points=whole.points,
        surface=None if reference is None else reference.surface(),
        settings=pipeline,
        seed=settings.seed,
    )


def _dense(points: Points, tiles: Tiles, least: int) -> NDArray[np.intp]:
    """Return the places of the tiles in which points (N, 3), map frame, number at least `least`."""
    cells, counts = np.unique(tiles.grid.locate(points), return_counts=True)
    return np.flatnonzero(np.isin(tiles.grid.cells(tiles.indices), cells[counts >= least]))
