"""How well two aligned clouds agree where both have something, looked at from both sides.

Fitness at a 5 cm gate counts point pairs, and so falls with the spacing of the points: two true scans of one
room, ten metres wide, reach only 0.48 (`room_scan`). Here a point agrees when it lies on the other cloud's
*surface*: near enough to have a neighbour there that was seen from the same side (the other side of a wall is
a place the map has not seen, not a contradiction), and close to that neighbour's tangent plane.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import inverse, transformed
from worker.cloud.types import Matrix4
from worker.pipeline.registration.icp import Surface, facing

_SAMPLE = 10_000  # points asked in each direction; a share of them is known to half a percent


@dataclass(frozen=True, kw_only=True, slots=True)
class TwoWayInliers:
    """Shares in 0..1, the worse side first named."""

    overlap: float  #: of the scan's points with a map point within reach, seen from the same side
    forward: float  #: of those, on the map's surface
    backward: float  #: the same of the map's points on the scan's surface

    @property
    def mutual(self) -> float:
        """The worse of the two directions."""
        return min(self.forward, self.backward)

    @property
    def score(self) -> float:
        """Ranks candidate poses: agreement times how much was compared."""
        return self.mutual * self.overlap


def agreement(
    source: Surface, target: Surface, target_from_source: Matrix4, *, reach: float, surface_distance: float
) -> TwoWayInliers:
    """Compare both clouds under the pose; `reach` and `surface_distance` are metres."""
    look = functools.partial(surface_share, reach=reach, surface_distance=surface_distance)
    overlap, forward = look(_sampled(source), target, target_from_source)
    source_from_target = inverse(target_from_source)
    _, backward = look(
        _sampled(_around(target, source, source_from_target, reach)), source, source_from_target
    )
    return TwoWayInliers(overlap=overlap, forward=forward, backward=backward)


def _sampled(surface: Surface) -> Surface:
    return surface.thinned(max(1, len(surface.points) // _SAMPLE))


def _around(target: Surface, source: Surface, source_from_target: Matrix4, reach: float) -> Surface:
    """What of the target can be near the source: a scan covers little of a large map."""
    points = transformed(target.points, source_from_target)
    low, high = source.points.min(axis=0) - reach, source.points.max(axis=0) + reach
    near = np.all((points > low) & (points < high), axis=1)
    return Surface(
        points=target.points[near],
        normals=target.normals[near],
        oriented=target.oriented[near],
        tree=target.tree,
    )


def surface_share(
    cloud: Surface, surface: Surface, surface_from_cloud: Matrix4, *, reach: float, surface_distance: float
) -> tuple[float, float]:
    """Share of the cloud within reach of the surface and seen from its side, and of that the share that lies on it."""
    if not len(cloud.points):
        return 0.0, 0.0
    points = transformed(cloud.points, surface_from_cloud)
    distance, index = surface.nearest(points, within=reach)
    near = np.isfinite(distance)
    covered = facing(cloud, surface, surface_from_cloud, index, near)
    if not covered.any():
        return 0.0, 0.0
    gap = points[covered] - surface.points[index[covered]]
    off_plane = np.abs(np.einsum("ij,ij->i", gap, surface.normals[index[covered]]))
    return float(covered.mean()), float((off_plane < surface_distance).mean())
