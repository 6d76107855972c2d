"""Residual misalignment: how far a survey lies off the map in each tile, by the poses alone; and what they claim."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.trajectory import PlacedScan
from worker.cloud.poses import transformed
from worker.cloud.tiling import TileGrid
from worker.cloud.types import Floats, Indices


def residual_misalignments(
    first: Sequence[PlacedScan], second: Sequence[PlacedScan], grid: TileGrid, indices: Indices
) -> Floats:
    """Return metres (T,) between where the second visit's poses put the middle of each tile and where the first's do.

    Each visit's shift is the mean over its scans, by the points that they have in the tile. NaN where one has none.
    """
    apart: Floats = np.linalg.norm(_shifts(second, grid, indices) - _shifts(first, grid, indices), axis=1)
    return apart


def stated_sigmas(scans: Sequence[PlacedScan], grid: TileGrid, indices: Indices) -> Floats:
    """Return metres (T,): root mean square, by points, of what the scans' stored sigmas come to at each tile's middle.

    NaN where no scan that states a sigma has a point.
    """
    total, weight = np.zeros(len(indices)), np.zeros(len(indices))
    middles = grid.centers(indices)
    for scan in scans:
        sigma = scan.placement.uncertainty
        if sigma is None:
            continue
        away = np.linalg.norm(middles - scan.placement.map_from_scan[:3, 3], axis=1)
        points = points_in(scan, grid, indices)
        total += points * (sigma.translation**2 + (sigma.rotation * away) ** 2)
        weight += points
    stated: Floats = np.sqrt(_means(total, weight))
    return stated


def points_in(scan: PlacedScan, grid: TileGrid, indices: Indices) -> NDArray[np.int64]:
    """Count the points of the scan in each tile: (T,)"""
    cells = grid.locate(transformed(scan.points, scan.placement.map_from_scan))
    counts = np.bincount(cells[cells >= 0], minlength=int(np.prod(grid.shape)))
    wanted: NDArray[np.int64] = counts[grid.cells(indices)]
    return wanted


def _shifts(scans: Sequence[PlacedScan], grid: TileGrid, indices: Indices) -> Floats:
    """Average over the scans what their errors do to each tile's middle: (T, 3) metres."""
    total, weight = np.zeros((len(indices), 3)), np.zeros(len(indices))
    middles = grid.centers(indices)
    for scan in scans:
        points = points_in(scan, grid, indices)
        total += points[:, None] * (transformed(middles, scan.map_from_true) - middles)
        weight += points
    return np.stack([_means(column, weight) for column in total.T], axis=1)


def _means(total: Floats, weight: Floats) -> Floats:
    means: Floats = np.divide(total, weight, out=np.full(len(total), np.nan), where=weight > 0)
    return means
