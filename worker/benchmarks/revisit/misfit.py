"""How far a survey's points lie off the map's in each tile, because of the poses alone; and what the poses claim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.poses import inverse, transformed
from worker.cloud.tiling import TileGrid
from worker.cloud.types import Floats, Indices, Matrix4, Points
from worker.pipeline.registration.results import RegistrationResult


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacedScan:
    """An accepted scan with the truth about it."""

    points: Points  #: (N, 3) metres, scan frame
    placement: RegistrationResult
    true: Matrix4  #: (4, 4) map_from_scan as it would be without error

    @property
    def map_from_true(self) -> Matrix4:
        """What the error of the pose does to a point of the map frame."""
        moved: Matrix4 = self.placement.map_from_scan @ inverse(self.true)
        return moved


def residual_misalignments(
    first: Sequence[PlacedScan], second: Sequence[PlacedScan], grid: TileGrid, indices: Indices
) -> Floats:
    """(T,) metres between where the second visit's poses put the middle of each tile and where the first's do.

    Each visit's shift is the mean over its scans, by the points that they have in the tile. NaN where one has none.
    """
    apart: Floats = np.linalg.norm(_shifts(second, grid, indices) - _shifts(first, grid, indices), axis=1)
    return apart


def stated_sigmas(scans: Sequence[PlacedScan], grid: TileGrid, indices: Indices) -> Floats:
    """(T,) metres: root mean square, by points, of what the scans' stored sigmas come to at each tile's middle.

    NaN where no scan that states a sigma has a point.
    """
    total, weight = np.zeros(len(indices)), np.zeros(len(indices))
    middles = grid.centers(indices)
    for scan in scans:
        sigma = scan.placement.uncertainty
        if sigma is None:
            continue
        away = np.linalg.norm(middles - scan.placement.map_from_scan[:3, 3], axis=1)
        here = points_in(scan, grid, indices)
        total += here * (sigma.translation**2 + (sigma.rotation * away) ** 2)
        weight += here
    stated: Floats = np.sqrt(_means(total, weight))
    return stated


def points_in(scan: PlacedScan, grid: TileGrid, indices: Indices) -> NDArray[np.int64]:
    """(T,) points of the scan in each tile."""
    there = transformed(scan.points, scan.placement.map_from_scan)
    cells = np.floor((there - grid.origin) / grid.size).astype(np.int64) - grid.lowest
    inside = cells[np.all((cells >= 0) & (cells < grid.shape), axis=1)]
    counts = np.bincount(
        np.ravel_multi_index(tuple(inside.T), grid.shape), minlength=int(np.prod(grid.shape))
    )
    wanted: NDArray[np.int64] = counts[np.ravel_multi_index(tuple((indices - grid.lowest).T), grid.shape)]
    return wanted


def _shifts(scans: Sequence[PlacedScan], grid: TileGrid, indices: Indices) -> Floats:
    """(T, 3) metres, mean over the scans."""
    total, weight = np.zeros((len(indices), 3)), np.zeros(len(indices))
    middles = grid.centers(indices)
    for scan in scans:
        here = points_in(scan, grid, indices)
        total += here[:, None] * (transformed(middles, scan.map_from_true) - middles)
        weight += here
    return np.stack([_means(column, weight) for column in total.T], axis=1)


def _means(total: Floats, weight: Floats) -> Floats:
    means: Floats = np.divide(total, weight, out=np.full(len(total), np.nan), where=weight > 0)
    return means
