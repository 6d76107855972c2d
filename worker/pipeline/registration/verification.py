"""Whether an aligned pose is true: inliers both ways, degeneracy, ambiguity, and free space.

Fitness at 5 cm counts point pairs, and so falls with the spacing of the points: two true scans of one room, ten metres
wide, reach only 0.48 (`room_scan`). Here a point is an inlier when it lies on the other cloud's *surface*: near enough
to have a neighbour there that was seen from the same side (the other side of a wall is a place the map has not seen,
not a contradiction), and close to that neighbour's tangent plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import difference, inverse, transformed
from worker.cloud.types import Matrix4
from worker.cloud.visibility import RangeImage
from worker.pipeline.registration.diagnosis import Diagnosis, Reason
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, facing, least_eigenvalue

REACH = 0.3  #: metres; farther from the map than this, a point is where the map has nothing to say
#: metres; nearer to its sensor than this a scan sees the robot that carries it, which proves nothing
ROBOT = 1.0
_SAMPLE = 10_000  # points asked in each direction; a share of them is known to half a percent
_PERTURBATIONS = ((0.15, 0.0), (-0.15, 0.0), (0.0, 0.15), (0.0, -0.15))  # metres, x and y
_AS_GOOD = 0.9  # of the best pose's score


@dataclass(frozen=True, kw_only=True, slots=True)
class TwoWayInliers:
    """Shares in 0..1 of two clouds under one pose."""

    overlap: float  #: of the scan's points with a map point within reach, seen from the same side
    forward: float  #: of those, on the map's surface
    backward: float  #: the same of the map's points on the scan's surface

    @property
    def ratio(self) -> float:
        """The two-way inlier ratio: the worse of the two directions."""
        return min(self.forward, self.backward)


def two_way_inliers(
    source: Surface, target: Surface, target_from_source: Matrix4, *, surface_distance: float
) -> TwoWayInliers:
    """Compare both clouds under the pose, within `REACH`; `surface_distance` is metres off the tangent plane."""
    source_from_target = inverse(target_from_source)
    # what of the target can be near the source: a scan covers little of a large map
    there = transformed(target.points, source_from_target)
    low, high = source.points.min(axis=0) - REACH, source.points.max(axis=0) + REACH
    around = target.selected(np.all((there > low) & (there < high), axis=1))
    overlap, forward = inlier_share(
        _sampled(source), target, target_from_source, surface_distance=surface_distance
    )
    _, backward = inlier_share(
        _sampled(around), source, source_from_target, surface_distance=surface_distance
    )
    return TwoWayInliers(overlap=overlap, forward=forward, backward=backward)


def _sampled(surface: Surface) -> Surface:
    return surface.selected(np.s_[:: max(1, len(surface.points) // _SAMPLE)])


def inlier_share(
    cloud: Surface, surface: Surface, surface_from_cloud: Matrix4, *, surface_distance: float
) -> tuple[float, float]:
    """Return the share of the cloud near the surface and seen from its side, and of that the share that lies on it."""
    if not len(cloud.points):
        return 0.0, 0.0
    points = transformed(cloud.points, surface_from_cloud)
    distance, index = surface.nearest(points, within=REACH)
    covered = facing(cloud, surface, surface_from_cloud, index, np.isfinite(distance))
    if not covered.any():
        return 0.0, 0.0
    gap = points[covered] - surface.points[index[covered]]
    off_plane = np.abs(np.einsum("ij,ij->i", gap, surface.normals[index[covered]]))
    return float(covered.mean()), float((off_plane < surface_distance).mean())


def free_space_violation(a: PreparedScan, b: PreparedScan, b_from_a: Matrix4, *, every: int = 4) -> float:
    """Return the share (0..1) of one scan's points that stand where the other saw free space, the worse direction.

    0 where one of the sensors is not known. True poses of simulated scans have 0.000, wrong ones that ICP is content
    with 0.001 to 0.14.
    """
    if a.image is None or b.image is None:
        return 0.0
    return max(
        _violation(a, b.image, b_from_a, every),
        _violation(b, a.image, inverse(b_from_a), every),
    )


def _violation(scan: PreparedScan, image: RangeImage, image_from_scan: Matrix4, every: int) -> float:
    points = scan.surface.points[::every]
    if scan.origin is not None:
        points = points[np.linalg.norm(points - scan.origin, axis=1) > ROBOT]
    violates = image.free_space_violation(transformed(points, image_from_scan))
    return float(violates.mean()) if len(violates) else 0.0


def require_accepted(name: str, hypothesis: Hypothesis, settings: RegistrationSettings) -> None:
    """Raise ScanRejected with all numbers where the best hypothesis is not accepted."""
    if hypothesis.is_accepted(settings):
        return
    reason: Reason = "no_fit"
    if hypothesis.contradicts_prior:
        reason = "wrong_prior"
        advice = "it ends far from the pose prior that was given; check the prior, or leave it out"
    elif hypothesis.consistent_with_prior:
        advice = "check the pose prior that was given, and that the place is in the map"
    else:
        advice = "give an initial pose, or check that the place is in the map"
    raise rejected(
        name,
        hypothesis,
        reason,
        f"{' and '.join(_shortcomings(hypothesis, settings)) or 'it fits elsewhere'}; {advice}",
    )


def _shortcomings(hypothesis: Hypothesis, settings: RegistrationSettings) -> list[str]:
    """Return which of the conditions of `Hypothesis.is_accepted` do not hold, each with its number and its limit."""
    short = []
    if not hypothesis.overlaps(settings):
        short.append(
            f"the map covers {hypothesis.overlap:.1%} of it, at least {hypothesis.required_overlap(settings):.0%} is "
            f"needed (or a fitness over {settings.min_fitness:g}, it has {hypothesis.fitness:.2f})"
        )
    required = hypothesis.required_inlier_ratio(settings)
    if hypothesis.two_way_inlier_ratio < required:
        short.append(
            f"of the surfaces that it shares with the map {hypothesis.two_way_inlier_ratio:.1%} lie on each other "
            f"(inlier ratio), at least {required:.0%} is needed"
        )
    if not hypothesis.inlier_rmse < settings.max_inlier_rmse:
        short.append(
            f"its inlier RMSE is {hypothesis.inlier_rmse * 100:.1f} cm, less than "
            f"{settings.max_inlier_rmse * 100:g} cm is needed"
        )
    return short


def require_constrained(
    name: str, source: Surface, target: Surface, hypothesis: Hypothesis, settings: RegistrationSettings
) -> None:
    """Raise ScanRejected where what scan and map share is degenerate: a rich scan may share but a plane."""
    there = transformed(source.points, hypothesis.target_from_source)
    distance, _ = target.nearest(there, within=settings.max_correspondence_distance)
    eigenvalue = least_eigenvalue(source.points[np.isfinite(distance)])
    if eigenvalue < settings.min_eigenvalue:
        raise rejected(
            name,
            hypothesis,
            "degenerate",
            f"what it shares with the map leaves a motion free (least eigenvalue {eigenvalue:.4f}, at least "
            f"{settings.min_eigenvalue:g} is needed); scan more of the mapped place",
        )


def require_unambiguous(
    name: str, best: Hypothesis, refine: Callable[[Matrix4], Hypothesis], settings: RegistrationSettings
) -> None:
    """Raise ScanRejected where a perturbed pose ends elsewhere and as good: nothing then says which is true.

    Asked where little is shared. A simulated scan that saw the map through a door fitted anywhere along 23 cm, inlier
    ratio 0.85 to 0.86 throughout.
    """
    if best.overlap >= settings.min_overlap:
        return
    for shift in _PERTURBATIONS:
        perturbed = best.target_from_source.copy()
        perturbed[:2, 3] += shift
        other = refine(perturbed)
        apart, _ = difference(other.target_from_source, best.target_from_source)
        as_good = other.score >= _AS_GOOD * best.score and other.is_accepted(settings)
        if as_good and apart > settings.max_ambiguity_distance:
            raise rejected(
                name,
                best,
                "ambiguous",
                f"it fits as well {apart * 100:.0f} cm away (inlier ratio {other.two_way_inlier_ratio:.2f} there, "
                f"{best.two_way_inlier_ratio:.2f} here, over {best.overlap:.0%} of the scan); "
                "scan more of the mapped place",
            )


def rejected(
    name: str, hypothesis: Hypothesis, reason: Reason, detail: str, **numbers: float
) -> ScanRejected:
    """Make the error of a scan with the numbers of its best hypothesis."""
    rmse = hypothesis.inlier_rmse
    return ScanRejected(
        Diagnosis(reason=reason, detail=f"scan {name}: {detail}", numbers=numbers),
        fitness=hypothesis.fitness,
        inlier_rmse=rmse if np.isfinite(rmse) else None,
    )
