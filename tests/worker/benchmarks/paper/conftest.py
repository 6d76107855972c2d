"""A map of four tiles, each a box of points, seen by three scans."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.paper.site import Site
from worker.cloud.tiling import cut, grid_over
from worker.cloud.types import Points
from worker.cloud.voxels import Voxels, merged_in_order
from worker.pipeline.settings import PipelineSettings

TILES = 4
POINTS = 2000  #: of a scan in a tile


def cloud(seed: int, tiles: int = TILES) -> Points:
    """Points all over boxes of 1.5 x 1.5 x 1.0 m in a row along x; as many in each."""
    rng = np.random.default_rng(seed)
    size = np.array([1.5, 1.5, 1.0])
    boxes = [rng.random((POINTS, 3)) * size + [1.5 * tile, 0, 0] for tile in range(tiles)]
    return np.concatenate(boxes).astype(np.float32)


@pytest.fixture
def site() -> Site:
    """Three scans that stand at the origin of the map; the third saw two tiles only."""
    settings = PipelineSettings()
    scans = (cloud(1), cloud(2), cloud(3, tiles=2))
    corners = np.array([[0, 0, 0], [1.5 * TILES - 0.01, 1.49, 0.99]], np.float32)
    grid = grid_over(corners, tile_size=settings.tiling.tile_size, voxel_size=0.05)
    voxels = tuple(Voxels.of(points, size=0.05) for points in scans)
    whole = merged_in_order(voxels)
    tiles = cut(whole.points, grid, min_points=512)
    flat = grid.cells(tiles.indices)
    dense = tuple(np.flatnonzero(np.isin(flat, grid.locate(points))) for points in scans)
    return Site(
        name="boxes",
        scans=scans,
        poses=(np.eye(4),) * 3,
        voxels=voxels,
        tiles=tiles,
        dense=dense,
        points=whole.points,
        surface=None,
        settings=settings,
        seed=1,
    )
