"""The tile manifest of a map (paper, Table A1)."""

from __future__ import annotations

from typing import Any

import numpy as np

from worker.cloud.patches import patch
from worker.cloud.tiling import Tiles, tile_id
from worker.cloud.types import Points

PATCHES = "tiles.npz"  #: one archive of arrays instead of two files a tile


def manifest(
    points: Points, tiles: Tiles, *, patch_size: int, min_points: int, voxel_size: float
) -> dict[str, Any]:
    """Table A1's fields for the map cloud (M, 3) and its tiles; JSON-ready, metres, map frame.

    Two differences: `file` and `dense_file` name an array within one archive, and `tile_origin` and
    `tile_lowest_idx` are added, so that the grid can be rebuilt exactly. `dense_voxel` is the map's voxel size.
    """
    size = [float(edge) for edge in tiles.grid.size]
    n_cells = tiles.grid.shape[0] * tiles.grid.shape[1] * tiles.grid.shape[2]
    centers = tiles.grid.centers(tiles.indices)
    return {
        "tile_size": size,
        "tile_origin": [float(value) for value in tiles.grid.origin],
        "patch_size": patch_size,
        "min_points": min_points,
        "save_dense_tiles": True,
        "dense_voxel": voxel_size,
        "map_bounds": {
            "min": [float(value) for value in points.min(axis=0)],
            "max": [float(value) for value in points.max(axis=0)],
        },
        "n_tiles_grid": list(tiles.grid.shape),
        "tile_lowest_idx": list(tiles.grid.lowest),
        "patches": [
            {
                "patch_id": tile_id(index),
                "tile_idx": [int(value) for value in index],
                "tile_center": [round(float(value), 6) for value in center],
                "n_original_points": len(tile),
                "n_sampled_points": patch_size,
                "file": f"{PATCHES}#patch/{tile_id(index)}",
                "dense_file": f"{PATCHES}#dense/{tile_id(index)}",
            }
            for index, center, tile in zip(tiles.indices, centers, tiles.points, strict=True)
        ],
        "n_valid_patches": len(tiles.points),
        "n_skipped_tiles": n_cells - len(tiles.points),
    }


def padded_patches(tiles: Tiles, *, size: int, seed: int) -> tuple[Points, ...]:
    """T patches (size, 3) float32, metres, each relative to its tile's centre, as Table A1 stores them."""
    centers = tiles.grid.centers(tiles.indices)
    return tuple(
        patch((points - center).astype(np.float32), size=size, seed=seed).padded()
        for points, center in zip(tiles.points, centers, strict=True)
    )
