"""Farthest points and the points in a ball around each (Qi et al. 2017, Section 3.2), for a pyramid of levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.patches import farthest_points
from worker.cloud.types import Points
from worker.detectors.siamese.prepared import starts

Rows = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Level:
    """One set abstraction."""

    centres: int  #: at most; a cloud with fewer points has each for a centre
    radius: float  #: metres
    neighbours: int  #: of a centre that are looked at
    widths: tuple[int, ...]  #: of the shared layers


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Groups:
    """Centres of one level and the points around them; rows are of the level below, all clouds end to end."""

    centres: Rows  #: (C,)
    neighbours: Rows  #: (C, K)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class GroupedClouds:
    """B clouds end to end, grouped at every level."""

    points: Points  #: (P, 3) metres
    levels: tuple[Groups, ...]
    sizes: list[int]  #: (B,) centres of the last level in each cloud


def grouped(clouds: Sequence[Points], levels: Sequence[Level]) -> GroupedClouds:
    """Group the points (n, 3) of each cloud, metres; any order of them gives the same groups."""
    ordered = [cloud[np.lexsort(cloud.T)] for cloud in clouds]
    each = [_groups(cloud, levels) for cloud in ordered]
    return GroupedClouds(
        points=np.concatenate(ordered),
        levels=tuple(_end_to_end(parts) for parts in _with_sizes(ordered, each)),
        sizes=[len(groups[-1].centres) for groups in each],
    )


def _groups(points: Points, levels: Sequence[Level]) -> list[Groups]:
    """Group one cloud.

    The first points of a farthest point sampling are that of fewer points, and of the points that a longer one chose:
    so one sampling serves every level, and a level's centres are the first of the level below.
    """
    most = min(levels[0].centres, len(points))
    chosen = farthest_points(points, most, start=0) if most < len(points) else np.arange(most)
    groups = []
    for level in levels:
        chosen = chosen[: level.centres]
        groups.append(
            Groups(
                centres=chosen,
                neighbours=ball_query(points, points[chosen], level.radius, level.neighbours),
            )
        )
        points, chosen = points[chosen], np.arange(len(chosen))
    return groups


def ball_query(points: Points, centres: Points, radius: float, count: int) -> Rows:
    """Return rows (C, count) of the nearest of (n, 3) points within `radius` of each of (C, 3) centres, nearest first.

    Where fewer are in the ball the nearest is repeated, which a maximum does not see. Each centre is one of the points.
    """
    distances, rows = _nearest(points, centres, radius, min(count, len(points)))
    rows = np.where(np.isinf(distances), rows[:, :1], rows)
    return np.concatenate([rows, np.repeat(rows[:, :1], count - rows.shape[1], axis=1)], axis=1)


def _nearest(points: Points, centres: Points, radius: float, count: int) -> tuple[NDArray[np.float64], Rows]:
    """Return distances and rows (C, count), nearest first; the distance is infinite where it is `radius` or more."""
    try:
        from scipy.spatial import cKDTree  # noqa: PLC0415 (optional where only training runs)
    except ImportError:
        return nearest_numpy(points, centres, radius, count)
    tree = cKDTree(points, balanced_tree=False)
    distances, rows = tree.query(centres, k=range(1, count + 1), distance_upper_bound=radius)
    return distances, rows


def nearest_numpy(
    points: Points, centres: Points, radius: float, count: int
) -> tuple[NDArray[np.float64], Rows]:
    """Do as `_nearest` with no library but NumPy, by all distances."""
    offsets = centres[:, None].astype(np.float64) - points
    squares = np.einsum("cnk,cnk->cn", offsets, offsets)
    rows = np.argsort(squares, axis=1, kind="stable")[:, :count]
    distances = np.sqrt(np.take_along_axis(squares, rows, axis=1))
    return np.where(distances < radius, distances, np.inf), rows


def _with_sizes(clouds: Sequence[Points], each: Sequence[Sequence[Groups]]) -> list[list[tuple[int, Groups]]]:
    """Return for every level the groups of each cloud, beside how many points the level below has there."""
    levels = []
    below = [len(cloud) for cloud in clouds]
    for groups in zip(*each, strict=True):
        levels.append(list(zip(below, groups, strict=True)))
        below = [len(group.centres) for group in groups]
    return levels


def _end_to_end(parts: Sequence[tuple[int, Groups]]) -> Groups:
    sizes, groups = zip(*parts, strict=True)
    first = starts(sizes)
    return Groups(
        centres=np.concatenate([one.centres + at for one, at in zip(groups, first, strict=True)]),
        neighbours=np.concatenate([one.neighbours + at for one, at in zip(groups, first, strict=True)]),
    )
