"""The tile manifest of a map (paper, Table A1)."""

from __future__ import annotations

from typing import Any

from worker.cloud.tiling import Tiles, tile_id
from worker.cloud.types import Points


def manifest(
    points: Points, tiles: Tiles, *, patch_size: int | None, min_points: int, voxel_size: float
) -> dict[str, Any]:
    """Return Table A1's fields for the map cloud (M, 3) and its tiles; JSON-ready, metres, map frame.

    `tile_origin` and `tile_lowest_idx` are added to them, so that the grid can be rebuilt exactly. `dense_voxel` is
    the map's voxel size. No tile has a file: the tiles are cut from the map's cloud along the grid, so `file` and
    `dense_file` are null and `save_dense_tiles` is false. `patch_size` is null for a detector that has no patches.
    """
    size = [float(edge) for edge in tiles.grid.size]
    n_cells = tiles.grid.shape[0] * tiles.grid.shape[1] * tiles.grid.shape[2]
    centers = tiles.grid.centers(tiles.indices)
    return {
        "tile_size": size,
        "tile_origin": [float(value) for value in tiles.grid.origin],
        "patch_size": patch_size,
        "min_points": min_points,
        "save_dense_tiles": False,
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
                "file": None,
                "dense_file": None,
            }
            for index, center, tile in zip(tiles.indices, centers, tiles.points, strict=True)
        ],
        "n_valid_patches": len(tiles.points),
        "n_skipped_tiles": n_cells - len(tiles.points),
    }
