"""Two scans of one place: where one stands in the frame of the other (paper, Section 3.3.2)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from worker.cloud.types import Floats, Matrix4
from worker.pipeline.registration.hypothesis import (
    CoarsePose,
    Hypothesis,
    better,
    coarse_pose,
    is_accepted,
    refined,
)
from worker.pipeline.registration.icp import normal_equations
from worker.pipeline.registration.preprocessing import PreparedScan, free_space_violation
from worker.pipeline.registration.settings import RegistrationSettings

_ROUGHLY_THROUGH = 10  # times the share that is accepted: a candidate is decimetres off
_DOUBTFUL, _CERTAIN = 0.8, 0.95  # agreement
_FREE = 0.001  # share of points in free space at which half of the confidence is gone


@dataclass(frozen=True, kw_only=True, slots=True)
class PairResult:
    """One registration of a source scan to a target scan, accepted or not."""

    target: int  #: index of the file
    source: int
    target_from_source: Matrix4
    fitness: float  #: 0..1
    inlier_rmse: float  #: metres; inf where nothing is near
    overlap: float  #: share of the source that the target covers, 0..1
    agreement: float  #: share of the overlap on a common surface, worse direction, 0..1
    free_space_violation: (
        float  #: share of points that stand where the other saw free space, worse direction, 0..1
    )
    consistent_with_prior: bool  #: near the pose priors of both scans
    accepted: bool
    information: Floats  #: (6, 6) of twists in the target's frame, see `icp.NormalEquations`

    @property
    def score(self) -> float:
        """0..1, ranks registrations: how much agrees."""
        return self.agreement * self.overlap

    @property
    def confidence(self) -> float:
        """0..1, how far this registration is to be believed where others contradict it.

        In a corridor without priors right ones had agreement 0.88 to 0.98 and nothing in free space, wrong ones 0.85 to
        0.92 and mostly 0.001 to 0.01 of their points (docs/decisions/0013).
        """
        surfaces = np.clip((self.agreement - _DOUBTFUL) / (_CERTAIN - _DOUBTFUL), 0.05, 1.0) ** 2
        return float(surfaces / (1 + (self.free_space_violation / _FREE) ** 2))

    def document(self) -> dict[str, Any]:
        """As JSON."""
        names = ("target", "source", "fitness", "inlier_rmse", "overlap", "agreement", "free_space_violation")
        values = {name: getattr(self, name) for name in names}
        values["inlier_rmse"] = self.inlier_rmse if np.isfinite(self.inlier_rmse) else None
        return values | {
            "consistent_with_prior": self.consistent_with_prior,
            "accepted": self.accepted,
            "target_from_source": self.target_from_source.tolist(),
            "information": self.information.tolist(),
        }

    @classmethod
    def of_document(cls, document: dict[str, Any]) -> Self:
        """What `document` gave; raises KeyError, TypeError or ValueError on anything else."""
        values = dict(document)
        rmse = values.pop("inlier_rmse")
        return cls(
            target_from_source=np.array(values.pop("target_from_source"), np.float64).reshape(4, 4),
            information=np.array(values.pop("information"), np.float64).reshape(6, 6),
            inlier_rmse=float("inf") if rmse is None else rmse,
            **values,
        )


def register_pair(
    numbers: tuple[int, int],
    source: PreparedScan,
    target: PreparedScan,
    *,
    prior: Matrix4 | None,
    starts: Sequence[Matrix4] = (),
    settings: RegistrationSettings,
) -> PairResult:
    """ICP from the prior (target_from_source), or from each of the starts; the best is kept.

    `numbers` are the indices of target and source. With a prior, only a pose near it is accepted.
    """
    refine = functools.partial(
        refined, source.surface, target.surface, prior, settings=settings, tick=lambda: None
    )
    if prior is None:
        near = settings.model_copy(update={"coarse_distances": settings.coarse_distances[1:]})
        best = refine(starts[0], settings=near)
        for start in starts[1:]:
            if not is_accepted(best, settings):
                best = better(best, refine(start, settings=near))
    else:
        best = refine(None)
        if not is_accepted(best, settings):
            # where little is shared the wide gates may drag a good prior away
            narrow = settings.model_copy(update={"coarse_distances": settings.coarse_distances[-1:]})
            best = better(best, refine(None, settings=narrow))
    return judged(numbers, source, target, best, settings)


def judged(
    numbers: tuple[int, int],
    source: PreparedScan,
    target: PreparedScan,
    best: Hypothesis,
    settings: RegistrationSettings,
) -> PairResult:
    """The numbers of a refined pose of two scans, and whether it is believed."""
    pose = best.found.target_from_source
    through = free_space_violation(source, target, pose)
    limit = (
        settings.max_free_space_violation_near_prior
        if best.consistent_with_prior
        else settings.max_free_space_violation
    )
    equations = normal_equations(
        source.surface, target.surface, pose, within=settings.max_correspondence_distance, every=2
    )
    return PairResult(
        target=numbers[0],
        source=numbers[1],
        target_from_source=pose,
        fitness=best.found.fitness,
        inlier_rmse=best.found.inlier_rmse,
        overlap=best.seen.overlap,
        agreement=best.seen.mutual,
        free_space_violation=through,
        consistent_with_prior=best.consistent_with_prior,
        accepted=is_accepted(best, settings) and through <= limit,
        information=equations.information,
    )


def coarse_pair(
    source: PreparedScan, target: PreparedScan, start: Matrix4, settings: RegistrationSettings
) -> CoarsePose:
    """A quick look at one candidate, with free space asked before and after (10 ms); score 0 where that says no."""
    nowhere = CoarsePose(target_from_source=start, score=0.0)
    if (
        free_space_violation(source, target, start, every=16)
        > _ROUGHLY_THROUGH * settings.max_free_space_violation
    ):
        return nowhere
    rough = coarse_pose(source.surface, target.surface, start)
    through = free_space_violation(source, target, rough.target_from_source, every=16)
    return nowhere if through > 2 * settings.max_free_space_violation else rough
