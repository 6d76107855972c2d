"""Places: where a thing stands or stood, as an upright box and its outline from above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from worker.cloud.tiling import TileGrid, tile_id
from worker.cloud.types import Bools, Floats, Points

NEIGHBOURHOOD = 2.0  #: metres over the ground, in which the floor is looked for
DEEPEST = 3.0  #: metres that the floor may lie below a thing; deeper it may be another storey's
FLOOR = 2.0  #: percentile of the heights around: the lowest surface, but for a few stray points
FEWEST = 50  #: voxels of the map around a thing, to tell a floor
_YAWS = np.radians(np.arange(0, 90, 2.0))
_NEAREST_EDGE = 0.025  # metres; nearer to an edge of the box than this is on it


@dataclass(frozen=True, kw_only=True, slots=True)
class Place:
    """An upright box around a thing and what was seen of it; metres, map frame, z up."""

    center: tuple[float, float, float]  #: of the box
    size: tuple[float, float, float]  #: along the axes of the box: two that lie level, then its height
    yaw: float  #: radians from the map's x axis to the first axis of the box, counter-clockwise, 0 to pi / 2
    footprint: tuple[
        tuple[float, float], ...
    ]  #: x, y: convex outline from above, counter-clockwise, not closed
    height_over_floor: float | None  #: of the lower side of the box; None: no floor was seen near
    volume: float  #: cubic metres of the convex hull of what was seen
    voxels: int
    points: int  #: returns within the voxels
    tiles: tuple[str, ...]  #: ids of the tiles in which it has voxels, in the grid's order


def place_of(points: Floats, *, hits: int, floor: float | None, grid: TileGrid, voxel_size: float) -> Place:
    """Describe the place of a thing by its voxels' mean points (n, 3), n > 0, map frame; `floor` is the height of it.

    No side of the box is thinner than a voxel.
    """
    center, size, yaw = _box(points, least=voxel_size)
    indices = np.unique(np.floor((points - grid.origin) / grid.size).astype(np.int32), axis=0)
    return Place(
        center=_triple(center),
        size=_triple(size),
        yaw=float(yaw),
        footprint=_outline(points, center, size, yaw),
        height_over_floor=None if floor is None else round(float(center[2] - size[2] / 2 - floor), 3),
        volume=round(_volume(points, voxel_size=voxel_size), 4),
        voxels=len(points),
        points=hits,
        tiles=tuple(tile_id(index) for index in indices),
    )


def within(place: Place, points: Points | Floats, *, margin: tuple[float, float, float]) -> Bools:
    """Tell (N,) which points (N, 3) lie in a place's box grown by so many metres along its axes, both ways."""
    reach = np.asarray(place.size) / 2 + margin
    answer = np.zeros(len(points), bool)
    rows = np.flatnonzero(np.abs(points[:, 0] - place.center[0]) <= np.hypot(reach[0], reach[1]))
    away = _turned(points[rows] - np.asarray(place.center), -place.yaw)
    answer[rows] = np.all(np.abs(away) <= reach, axis=1)
    return answer


def floor_below(points: Floats, reference: Points) -> float | None:
    """Return the height of the lowest surface that the map (M, 3) has near a thing (n, 3); None where it has none.

    Where walls go on down to the deepest that is looked at, nothing can be said.
    """
    middle, bottom = points.mean(axis=0), points[:, 2].min()
    near = reference[np.abs(reference[:, 0] - middle[0]) < NEIGHBOURHOOD]
    near = near[np.hypot(near[:, 0] - middle[0], near[:, 1] - middle[1]) < NEIGHBOURHOOD]
    heights = near[(near[:, 2] > bottom - DEEPEST) & (near[:, 2] < bottom + 0.1), 2]
    if len(heights) < FEWEST:
        return None
    floor = float(np.percentile(heights, FLOOR))
    return None if floor < bottom - DEEPEST + 0.15 else floor


def _box(points: Floats, *, least: float) -> tuple[Floats, Floats, float]:
    """Return centre (3,), size (3,) and yaw of the upright box whose sides run along what was seen."""
    yaw = _box_yaw(points[:, :2])
    turned = _turned(points, -yaw)
    low, high = turned.min(axis=0), turned.max(axis=0)
    center = _turned(((low + high) / 2)[None], yaw)[0]
    return center, np.maximum(high - low, least), yaw


def _box_yaw(flat: Floats) -> float:
    """Return the yaw, 0 to pi / 2, of the rectangle whose sides the points (n, 2) lie nearest to.

    The least rectangle will not do: two sides of a thing, which is what one scan sees, fit into many of one area.
    Search and criterion ("closeness") are those of X. Zhang, W. Xu, C. Dong and J. Dolan, "Efficient L-shape fitting
    for vehicle detection using laser scanners", 2017.
    """
    columns: Floats = np.unique(np.round(flat / _NEAREST_EDGE), axis=0) * _NEAREST_EDGE
    return float(max(_YAWS, key=lambda yaw: _closeness(columns, yaw)))


def _closeness(flat: Floats, yaw: float) -> float:
    along = flat @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    gaps = np.minimum(along.max(axis=0) - along, along - along.min(axis=0)).min(axis=1)
    return float((1 / np.maximum(gaps, _NEAREST_EDGE)).mean())


def _outline(points: Floats, center: Floats, size: Floats, yaw: float) -> tuple[tuple[float, float], ...]:
    """Return the convex outline from above; the box's own where the points lie on a line."""
    try:
        flat = points[ConvexHull(points[:, :2]).vertices, :2]
    except QhullError:
        half = size / 2
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
        flat = _turned(corners, yaw)[:, :2] + center[:2]
    return tuple((round(float(x), 3), round(float(y), 3)) for x, y in flat)


def _volume(points: Floats, *, voxel_size: float) -> float:
    """Return the volume of the convex hull, and no less than that of a sheet a quarter as thick as its voxels."""
    least = len(points) * voxel_size**3 / 4
    try:
        return max(float(ConvexHull(points).volume), least)
    except QhullError:
        return least


def _turned(points: NDArray[np.floating], yaw: float) -> Floats:
    """Turn points (n, 3) by `yaw` radians about the z axis."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    turned: Floats = points.astype(np.float64) @ turn
    return turned


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 3) for value in values)
    return x, y, z
