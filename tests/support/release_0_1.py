"""The files of a data folder as release 0.1 wrote them: `np.savez` with its names, and nothing of today's code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from worker.cloud.tiling import Tiles
from worker.pipeline.mapping.fusion import CurrentMap, ReferenceMap
from worker.pipeline.registration.results import RegisteredScan


def reference_of_0_1(path: Path, reference: ReferenceMap) -> None:
    """`maps/{job}/reference.npz`: no grid."""
    _save(
        path,
        points=reference.points,
        normals=reference.normals,
        oriented=reference.oriented,
        voxel_size=np.array([reference.voxel_size]),
        colors=reference.colors,
    )


def tiles_of_0_1(path: Path, tiles: Tiles, *, lowest: bool = True) -> None:
    """`maps/{job}/tiles.npz`: the grid, and the points of each tile twice; a map that never grew had no `lowest`."""
    arrays: dict[str, Any] = {}
    for (i, j, k), points in zip(tiles.indices.tolist(), tiles.points, strict=True):
        arrays[f"dense/tile_{i:03d}_{j:03d}_{k:03d}"] = points
        arrays[f"patch/tile_{i:03d}_{j:03d}_{k:03d}"] = points
    _save(
        path,
        origin=tiles.grid.origin,
        size=tiles.grid.size,
        shape=np.array(tiles.grid.shape, np.int64),
        lowest=np.array(tiles.grid.lowest, np.int64) if lowest else None,
        indices=tiles.indices,
        **arrays,
    )


def current_of_0_1(path: Path, current: CurrentMap) -> None:
    """`surveys/{id}/current.npz`."""
    _save(path, points=current.points, colors=current.colors)


def scan_of_0_1(path: Path, scan: RegisteredScan) -> None:
    """`scans/*.npz`: no name."""
    _save(
        path,
        points=scan.points,
        map_from_scan=scan.map_from_scan,
        sensor_origin=scan.sensor_origin,
        colors=scan.colors,
    )


def _save(path: Path, **arrays: Any) -> None:
    with path.open("wb") as file:
        np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
