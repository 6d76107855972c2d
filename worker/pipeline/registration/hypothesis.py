"""Pose hypotheses: a refined pose with the numbers that decide whether it is believed."""

from __future__ import annotations

from dataclasses import dataclass

from worker.cloud.types import Matrix4
from worker.pipeline.registration.settings import RegistrationSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class Hypothesis:
    """A refined pose and what speaks for it."""

    target_from_source: Matrix4  #: (4, 4) rigid
    fitness: float  #: share of the source's points with a correspondence, 0..1
    inlier_rmse: float  #: metres, point to point; inf where nothing is near
    num_inliers: int  #: points of the source with a correspondence, of those that the last ICP took
    overlap: float  #: share of the source that the target covers, seen from the same side, 0..1
    two_way_inlier_ratio: float  #: share of the overlap on a common surface, worse direction, 0..1
    from_global_search: bool  #: the start came from the global registration, not from the prior
    consistent_with_prior: bool  #: near a given prior
    contradicts_prior: bool  #: far from a given prior
    oriented: bool  #: which side of its surfaces the source saw is known, so that the inlier ratio says more

    @property
    def score(self) -> float:
        """The inlier ratio times how much was compared, 0..1: ranks hypotheses."""
        return self.two_way_inlier_ratio * self.overlap

    def is_accepted(self, settings: RegistrationSettings) -> bool:
        """Ask for Table 1's RMSE, enough of the scan in the map, and inliers both ways; never against a prior."""
        return (
            not self.contradicts_prior
            and self.overlaps(settings)
            and self.inlier_rmse < settings.max_inlier_rmse
            and self.two_way_inlier_ratio >= self.required_inlier_ratio(settings)
        )

    def overlaps(self, settings: RegistrationSettings) -> bool:
        """Tell whether enough of the scan is in the map: by the overlap, or by Table 1's fitness."""
        return self.fitness > settings.min_fitness or self.overlap >= self.required_overlap(settings)

    def required_overlap(self, settings: RegistrationSettings) -> float:
        """Ask for less of the scan near a prior."""
        if self.consistent_with_prior:
            return min(settings.min_overlap, settings.min_overlap_near_prior)
        return settings.min_overlap

    def required_inlier_ratio(self, settings: RegistrationSettings) -> float:
        """Ask for more where the sides are known, which raises the ratio, and no prior speaks for the pose."""
        strict = self.oriented and not self.consistent_with_prior
        return max(settings.min_inlier_ratio, settings.min_inlier_ratio_without_prior if strict else 0.0)

    def free_space_limit(self, settings: RegistrationSettings) -> float:
        """Return the share of points, 0..1, that may stand in free space; more near a prior."""
        if self.consistent_with_prior:
            return settings.max_free_space_violation_near_prior
        return settings.max_free_space_violation


def better(one: Hypothesis, other: Hypothesis) -> Hypothesis:
    """Return the one of higher score; where there is a prior, one near it."""
    return max(one, other, key=lambda hypothesis: (not hypothesis.contradicts_prior, hypothesis.score))
