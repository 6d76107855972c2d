"""How well two aligned clouds agree where both have something, looked at from both sides.

Fitness at a 5 cm gate counts point pairs, and so falls with the spacing of the points: two true scans of one
room, ten metres wide, reach only 0.48 (`room_scan`). Here a point agrees when it lies on the other cloud's
*surface*: near enough to have a neighbour there, and close to that neighbour's tangent plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from worker.pipeline.icp import Surface
from worker.pipeline.poses import inverse, transformed
from worker.pipeline.values import Floats, Matrix4


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """Shares in 0..1, the worse side first named."""

    overlap: float  #: of the scan's points with a map point within reach
    forward: float  #: of those, on the map's surface
    backward: float  #: of the map's points with a scan point within reach, on the scan's surface

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
) -> Agreement:
    """Compare both clouds under the pose; `reach` and `surface_distance` are metres."""
    there = transformed(source.points, target_from_source)
    overlap, forward = _on_surface(there, target, reach, surface_distance)
    back = transformed(target.points, inverse(target_from_source))
    _, backward = _on_surface(back, source, reach, surface_distance)
    return Agreement(overlap=overlap, forward=forward, backward=backward)


def _on_surface(
    points: Floats, surface: Surface, reach: float, surface_distance: float
) -> tuple[float, float]:
    distance, index = surface.nearest(points, within=reach)
    near = np.isfinite(distance)
    if not near.any():
        return 0.0, 0.0
    gap = points[near] - surface.points[index[near]]
    off_plane = np.abs(np.einsum("ij,ij->i", gap, surface.normals[index[near]]))
    return float(near.mean()), float((off_plane < surface_distance).mean())
