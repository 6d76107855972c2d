"""Two scans of one place: where one stands in the frame of the other (paper, Section 3.3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from worker.cloud.types import Floats, Matrix4
from worker.pipeline.registration.hypothesis import Hypothesis, better
from worker.pipeline.registration.icp import normal_equations
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.refinement import CoarsePose, Refinement, coarse_alignment
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.verification import free_space_violation

_COARSE_VIOLATION = 10  # times the share that is accepted: a start is decimetres off
_DOUBTFUL, _CERTAIN = 0.8, 0.95  # two-way inlier ratio
_FREE = 0.001  # share of points in free space at which half of the confidence is gone


@dataclass(frozen=True, kw_only=True, slots=True)
class PairResult:
    """One registration of a source scan to a target scan, accepted or not."""

    target: int  #: index of the file
    source: int  #: index of the file
    target_from_source: Matrix4  #: (4, 4) rigid
    fitness: float  #: 0..1
    inlier_rmse: float  #: metres; inf where nothing is near
    overlap: float  #: share of the source that the target covers, 0..1
    two_way_inlier_ratio: float  #: share of the overlap on a common surface, worse direction, 0..1
    free_space_violation: float  #: share of points where the other saw free space, worse direction, 0..1
    consistent_with_prior: bool  #: near the pose priors of both scans
    accepted: bool
    information: Floats  #: (6, 6) of twists in the target's frame, see `icp.NormalEquations`

    @property
    def pair(self) -> tuple[int, int]:
        """Target and source."""
        return self.target, self.source

    @property
    def score(self) -> float:
        """The inlier ratio times how much was compared, 0..1: ranks registrations."""
        return self.two_way_inlier_ratio * self.overlap

    @property
    def confidence(self) -> float:
        """How far this registration is to be believed where others contradict it, 0..1.

        In a corridor without priors right ones had an inlier ratio of 0.88 to 0.98 and nothing in free space, wrong
        ones 0.85 to 0.92 and mostly 0.001 to 0.01 of their points (docs/decisions/0013).
        """
        surfaces = np.clip((self.two_way_inlier_ratio - _DOUBTFUL) / (_CERTAIN - _DOUBTFUL), 0.05, 1.0) ** 2
        return float(surfaces / (1 + (self.free_space_violation / _FREE) ** 2))

    def document(self) -> dict[str, Any]:
        """Return it as JSON; an infinite RMSE is null there."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return values | {
            "inlier_rmse": self.inlier_rmse if np.isfinite(self.inlier_rmse) else None,
            "target_from_source": self.target_from_source.tolist(),
            "information": self.information.tolist(),
        }

    @classmethod
    def of_document(cls, document: dict[str, Any]) -> Self:
        """Read what `document` gave; raises KeyError, TypeError or ValueError on anything else."""
        rmse = document["inlier_rmse"]
        arrays = {
            "target_from_source": np.array(document["target_from_source"], np.float64).reshape(4, 4),
            "information": np.array(document["information"], np.float64).reshape(6, 6),
        }
        return cls(**document | arrays | {"inlier_rmse": float("inf") if rmse is None else rmse})


def register_pair(
    indices: tuple[int, int],
    source: PreparedScan,
    target: PreparedScan,
    *,
    prior: Matrix4 | None,
    starts: Sequence[Matrix4] = (),
    settings: RegistrationSettings,
) -> PairResult:
    """Register by ICP from the prior (target_from_source), or from each of the starts; the best is kept.

    `indices` are those of target and source. With a prior, only a pose near it is accepted.
    """
    refinement = Refinement(source=source.surface, target=target.surface, prior=prior, settings=settings)
    if prior is not None:
        return verified_pair(indices, source, target, refinement.from_prior(prior), settings)
    near = refinement.with_distances(settings.coarse_distances[1:])
    best = near.from_start(starts[0])
    for start in starts[1:]:
        if not best.is_accepted(settings):
            best = better(best, near.from_start(start))
    return verified_pair(indices, source, target, best, settings)


def verified_pair(
    indices: tuple[int, int],
    source: PreparedScan,
    target: PreparedScan,
    hypothesis: Hypothesis,
    settings: RegistrationSettings,
) -> PairResult:
    """Ask free space of a refined pose of two scans, and return its numbers and whether it is accepted."""
    pose = hypothesis.target_from_source
    violation = free_space_violation(source, target, pose)
    equations = normal_equations(
        source.surface,
        target.surface,
        pose,
        max_correspondence_distance=settings.max_correspondence_distance,
        every=2,
    )
    return PairResult(
        target=indices[0],
        source=indices[1],
        target_from_source=pose,
        fitness=hypothesis.fitness,
        inlier_rmse=hypothesis.inlier_rmse,
        overlap=hypothesis.overlap,
        two_way_inlier_ratio=hypothesis.two_way_inlier_ratio,
        free_space_violation=violation,
        consistent_with_prior=hypothesis.consistent_with_prior,
        accepted=hypothesis.is_accepted(settings) and violation <= hypothesis.free_space_limit(settings),
        information=equations.information,
    )


def coarse_pair(
    source: PreparedScan, target: PreparedScan, start: Matrix4, settings: RegistrationSettings
) -> CoarsePose:
    """Align coarsely from one start, with free space asked before and after (10 ms); score 0 where that says no."""
    nowhere = CoarsePose(target_from_source=start, score=0.0)
    limit = settings.max_free_space_violation
    if free_space_violation(source, target, start, every=16) > _COARSE_VIOLATION * limit:
        return nowhere
    coarse = coarse_alignment(source.surface, target.surface, start)
    violation = free_space_violation(source, target, coarse.target_from_source, every=16)
    return nowhere if violation > 2 * limit else coarse
