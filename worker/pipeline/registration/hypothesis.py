"""A rough look at a candidate pose: a few steps of ICP with a few hundred points, to see which are worth a full one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import difference, exponential, transformed
from worker.cloud.types import Matrix4
from worker.pipeline.registration.bev_correlation import bev_candidates
from worker.pipeline.registration.fpfh_ransac import candidate_poses
from worker.pipeline.registration.icp import IcpResult, Surface, icp
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.verification import TwoWayInliers, agreement, surface_share

REACH = 0.3  #: metres; farther from the map than this, a point is where the map has nothing to say
_SAMPLE = 800  # points
_GATE, _STEPS = 0.6, 6  # metres; iterations of ICP
_ON_SURFACE = 0.1  # metres


@dataclass(frozen=True, kw_only=True, slots=True)
class CoarsePose:
    """A candidate after the look."""

    target_from_source: Matrix4
    score: float  #: share of the source on the target's surfaces, 0..1


def coarse_pose(source: Surface, target: Surface, start: Matrix4) -> CoarsePose:
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
    return CoarsePose(target_from_source=pose, score=overlap * on_surface)


def best_coarse(source: Surface, target: Surface, starts: Iterable[Matrix4]) -> list[CoarsePose]:
    """Every start looked at, the best first."""
    return sorted((coarse_pose(source, target, start) for start in starts), key=lambda each: -each.score)


_ENOUGH = 10_000  # points for the last gate: candidates are told apart by so many
_PLANS = 12  # places that the plans name
_BEST_PLANS = 4  # of those that get a full ICP
_WORTH = 0.3  # rough score of a candidate from features that does; right ones have 0.5 and more


@dataclass(frozen=True, kw_only=True, slots=True)
class Hypothesis:
    """A refined pose; everything that decides whether it is believed."""

    found: IcpResult
    seen: TwoWayInliers
    searched: bool  #: from the global search, not from the given start
    consistent_with_prior: bool  #: near a given prior
    contradicts_prior: bool  #: far from a given prior
    oriented: bool  #: which side of its surfaces the scan saw is known, so that agreement says more


def searched(
    source: Surface,
    target: Surface,
    best: Hypothesis | None,
    prior: Matrix4 | None,
    refine: Callable[[Matrix4], Hypothesis],
    settings: RegistrationSettings,
) -> Hypothesis:
    """The best pose of the search, or what was there before it; `prior` is map_from_scan."""
    for pose in _anywhere(source, target, prior, settings):
        if prior is not None and not _is_near(pose, prior, settings):
            continue
        best = refine(pose) if best is None else better(best, refine(pose))
        if (
            is_accepted(best, settings)
            and best.seen.mutual > needed_agreement(best, settings) + settings.sure_margin
        ):
            break
    return refine(np.eye(4)) if best is None else best


def _anywhere(
    source: Surface, target: Surface, prior: Matrix4 | None, settings: RegistrationSettings
) -> Iterator[Matrix4]:
    """Candidates: identity and what plans say, after a rough look; then, more slowly, what local features say."""
    starts = [np.eye(4)] if prior is None else []
    if settings.search_resolutions:
        plans = bev_candidates(source, target, count=_PLANS if prior is None else 4 * _PLANS)
        starts += [start for start in plans if prior is None or _is_near(start, prior, settings)]
    for rough in best_coarse(source, target, starts)[:_BEST_PLANS]:
        yield rough.target_from_source
    seeds = settings.search_seeds if prior is None else 1
    for pose in candidate_poses(source, target, resolutions=settings.search_resolutions, seeds=seeds):
        rough = coarse_pose(source, target, pose)
        if rough.score >= _WORTH:
            yield rough.target_from_source


def turned(
    source: Surface, target: Surface, best: Hypothesis, refine: Callable[[Matrix4], Hypothesis]
) -> Hypothesis:
    """The best of a pose and its quarter turns: a rectangular room fits itself turned about its middle.

    Not asked where a prior vouches for the pose, nor of a turn that does worse even at a lenient look.
    """
    if best.consistent_with_prior:
        return best
    for pose in _quarter_turns(source, best.found.target_from_source):
        rough = coarse_pose(source, target, pose)
        if rough.score >= best.seen.score:
            best = better(best, refine(rough.target_from_source))
    return best


def better(best: Hypothesis, other: Hypothesis) -> Hypothesis:
    """The one that agrees with the map over more of the scan; where there is a prior, one near it."""
    return max(best, other, key=lambda each: (not each.contradicts_prior, each.seen.score))


def _quarter_turns(source: Surface, pose: Matrix4) -> Iterator[Matrix4]:
    there = transformed(source.points, pose)
    center = (there.min(axis=0) + there.max(axis=0)) / 2
    for quarter in (1, 2, 3):
        turn = exponential(np.array([0.0, 0.0, quarter * np.pi / 2, 0.0, 0.0, 0.0]))
        turn[:3, 3] = center - turn[:3, :3] @ center
        yield turn @ pose


def refined(
    source: Surface,
    target: Surface,
    prior: Matrix4 | None,
    candidate: Matrix4 | None,
    *,
    settings: RegistrationSettings,
    tick: Callable[[], None],
) -> Hypothesis:
    """ICP from the candidate, or else the prior, or else identity, through ever smaller gates.

    The wide gates need only a part of the points.
    """
    pose = next((start for start in (candidate, prior) if start is not None), np.eye(4))
    last = settings.max_correspondence_distance
    enough = max(1, len(source.points) // _ENOUGH)
    gates = [gate for gate in settings.coarse_distances if gate > last]
    for level, gate in enumerate([*gates, last]):
        found = icp(
            source,
            target,
            pose,
            max_correspondence_distance=gate,
            max_iterations=settings.max_iterations,
            soft=gate > last,
            every=enough * 2 ** (len(gates) - level),
            tick=tick,
        )
        pose = found.target_from_source
    near = prior is not None and _is_near(pose, prior, settings)
    return Hypothesis(
        found=found,
        seen=agreement(source, target, pose, reach=REACH, surface_distance=last),
        searched=candidate is not None,
        consistent_with_prior=near,
        contradicts_prior=prior is not None and not near,
        oriented=bool(source.oriented.mean() > 0.5),
    )


def _is_near(pose: Matrix4, prior: Matrix4, settings: RegistrationSettings) -> bool:
    distance, angle = difference(pose, prior)
    return distance <= settings.prior_distance and angle <= settings.prior_angle


def is_accepted(candidate: Hypothesis, settings: RegistrationSettings) -> bool:
    """Table 1's RMSE, enough of the scan in the map, and agreement from both sides; never against a prior."""
    found, seen = candidate.found, candidate.seen
    overlap = settings.min_overlap
    if candidate.consistent_with_prior:
        overlap = min(overlap, settings.min_overlap_near_prior)
    return (
        not candidate.contradicts_prior
        and (found.fitness > settings.min_fitness or seen.overlap >= overlap)
        and found.inlier_rmse < settings.max_inlier_rmse
        and seen.mutual >= needed_agreement(candidate, settings)
    )


def needed_agreement(candidate: Hypothesis, settings: RegistrationSettings) -> float:
    """More is asked where the sides are known, which raises it, and no prior speaks for the pose."""
    strict = candidate.oriented and not candidate.consistent_with_prior
    return max(settings.min_inlier_ratio, settings.min_inlier_ratio_without_prior if strict else 0.0)
