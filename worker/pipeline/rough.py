"""A rough look at a candidate pose: a few steps of ICP with a few hundred points, to see which are worth a full one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from worker.pipeline.agreement import surface_share
from worker.pipeline.icp import Surface, icp
from worker.pipeline.values import Matrix4

REACH = 0.3  #: metres; farther from the map than this, a point is where the map has nothing to say
_SAMPLE = 800  # points
_GATE, _STEPS = 0.6, 6  # metres; iterations of ICP
_ON_SURFACE = 0.1  # metres


@dataclass(frozen=True, kw_only=True, slots=True)
class RoughPose:
    """A candidate after the look."""

    target_from_source: Matrix4
    score: float  #: share of the source on the target's surfaces, 0..1


def rough_pose(source: Surface, target: Surface, start: Matrix4) -> RoughPose:
    """Where a short ICP ends, and how much of the source then lies on the target (5 to 10 ms)."""
    every = max(1, len(source.points) // _SAMPLE)
    found = icp(
        source,
        target,
        start,
        max_correspondence_distance=_GATE,
        max_iterations=_STEPS,
        soft=True,
        every=every,
    )
    pose = found.target_from_source
    overlap, on_surface = surface_share(
        source.thinned(every), target, pose, reach=REACH, surface_distance=_ON_SURFACE
    )
    return RoughPose(target_from_source=pose, score=overlap * on_surface)


def best_rough(source: Surface, target: Surface, starts: Iterable[Matrix4]) -> list[RoughPose]:
    """Every start looked at, the best first."""
    return sorted((rough_pose(source, target, start) for start in starts), key=lambda each: -each.score)
