"""Refinement: ICP from one start through ever smaller correspondence distances, and what the result is worth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from worker.cloud.poses import difference
from worker.cloud.types import Matrix4
from worker.pipeline.registration.hypothesis import Hypothesis, better
from worker.pipeline.registration.icp import icp
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import inlier_share, two_way_inliers

_COARSE_POINTS, _COARSE_ITERATIONS = 800, 6
_COARSE_DISTANCE, _COARSE_ON_SURFACE = 0.6, 0.1  # metres
_ENOUGH = 10_000  # points for the last level: hypotheses are told apart by so many
_FINAL_ITERATIONS = 20  # of ICP with all points, at most


@dataclass(frozen=True, kw_only=True, slots=True)
class CoarsePose:
    """A start after coarse alignment."""

    target_from_source: Matrix4  #: (4, 4) rigid
    score: float  #: share of the source on the target's surfaces, 0..1


def coarse_alignment(source: Surface, target: Surface, start: Matrix4) -> CoarsePose:
    """Run a few steps of ICP with a few hundred points, to see whether a start is worth a full one (5 to 10 ms)."""
    every = max(1, len(source.points) // _COARSE_POINTS)
    pose = icp(
        source,
        target,
        start,
        max_correspondence_distance=_COARSE_DISTANCE,
        max_iterations=_COARSE_ITERATIONS,
        robust=True,
        every=every,
    ).target_from_source
    sample = source.selected(np.s_[::every])
    overlap, on_surface = inlier_share(sample, target, pose, surface_distance=_COARSE_ON_SURFACE)
    return CoarsePose(target_from_source=pose, score=overlap * on_surface)


def by_score(coarse: Iterable[CoarsePose]) -> list[CoarsePose]:
    """Sort, the best first."""
    return sorted(coarse, key=lambda pose: -pose.score)


@dataclass(frozen=True, kw_only=True, slots=True)
class Refinement:
    """ICP of one source to one target; every start becomes a hypothesis with the same prior and settings."""

    source: Surface
    target: Surface
    prior: Matrix4 | None  #: target_from_source as the client believes it
    settings: RegistrationSettings
    tick: Callable[[], None] = lambda: None  #: called before every iteration; may raise to stop the work

    def from_start(self, start: Matrix4, *, from_global_search: bool = True) -> Hypothesis:
        """Refine target_from_source; the wide correspondence distances need only a part of the points."""
        settings, pose = self.settings, start
        last = settings.max_correspondence_distance
        enough = max(1, len(self.source.points) // _ENOUGH)
        coarse = [distance for distance in settings.coarse_distances if distance > last]
        for level, distance in enumerate([*coarse, last]):
            result = icp(
                self.source,
                self.target,
                pose,
                max_correspondence_distance=distance,
                max_iterations=settings.max_iterations,
                robust=distance > last,
                every=enough * 2 ** (len(coarse) - level),
                tick=self.tick,
            )
            pose = result.target_from_source
        inliers = two_way_inliers(self.source, self.target, pose, surface_distance=last)
        return Hypothesis(
            target_from_source=pose,
            fitness=result.fitness,
            inlier_rmse=result.inlier_rmse,
            num_inliers=result.num_inliers,
            overlap=inliers.overlap,
            two_way_inlier_ratio=inliers.ratio,
            from_global_search=from_global_search,
            consistent_with_prior=self.prior is not None and self.is_near_prior(pose),
            contradicts_prior=not self.is_near_prior(pose),
            oriented=bool(self.source.oriented.mean() > 0.5),
        )

    def from_prior(self, prior: Matrix4) -> Hypothesis:
        """Refine the prior; where that does not do, again through the narrow distances alone.

        Where little is shared the wide ones may drag a good prior away.
        """
        hypothesis = self.from_start(prior, from_global_search=False)
        if hypothesis.is_accepted(self.settings):
            return hypothesis
        return better(hypothesis, self.narrow().from_start(prior, from_global_search=False))

    def narrow(self) -> Refinement:
        """Return the same with the last of the coarse distances alone."""
        return self.with_distances(self.settings.coarse_distances[-1:])

    def with_distances(self, coarse_distances: tuple[float, ...]) -> Refinement:
        """Return the same with other coarse distances, metres."""
        return replace(self, settings=self.settings.with_values(coarse_distances=coarse_distances))

    def final(self, hypothesis: Hypothesis) -> Hypothesis:
        """Refine a few steps more with every point: hypotheses were told apart by some of them.

        Sparse clouds gain by it; `ipad_rooms` 808 comes from 1.7 cm off to 0.6.
        """
        result = icp(
            self.source,
            self.target,
            hypothesis.target_from_source,
            max_correspondence_distance=self.settings.max_correspondence_distance,
            max_iterations=min(_FINAL_ITERATIONS, self.settings.max_iterations),
            tick=self.tick,
        )
        return replace(
            hypothesis,
            target_from_source=result.target_from_source,
            fitness=result.fitness,
            inlier_rmse=result.inlier_rmse,
            num_inliers=result.num_inliers,
        )

    def is_near_prior(self, pose: Matrix4) -> bool:
        """Tell whether a pose is as near to the prior as a prior may be off; without a prior every pose is."""
        if self.prior is None:
            return True
        distance, angle = difference(pose, self.prior)
        return distance <= self.settings.prior_distance and angle <= self.settings.prior_angle
