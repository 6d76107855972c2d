"""Multi-view refinement: all scans moved together until their points meet, then what each pose is worth.

A pose graph averages registrations; here the points themselves are asked again, every scan against all its neighbours
at once (multi-view point-to-plane ICP; Pulli, 3DIM 1999), so that a corridor's ends are held by everything between.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import adjoint, inverse, skew
from worker.cloud.types import Floats, Matrix4, Points
from worker.pipeline.mapping.pair_selection import Extent, likely_pairs
from worker.pipeline.mapping.pose_graph_optimization import Factor, covariances, retract, solve
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.mapping.tasks import LinearizedPair, LinearizeTask, Workspace, linearize
from worker.pipeline.registration.results import Uncertainty

_DISTANCES = (0.15, 0.1, 0.05)  # metres, correspondence distances of the rounds; the last one stays
_EVERY = (4, 4, 2)  # points of each scan, likewise
_NEIGHBOURS = 6  # that a scan is refined against
_DAMPING = 1e-6  # of a factor's own strength

#: Pairs of points are no independent witnesses: neighbours share a range error and a surface that is not quite plane.
#: So many count as one; set so that errors of simulated scans are of the size that is given.
CORRELATED = 100.0
#: What no number of points takes away: the range bias of a scan. One sigma, metres and radians.
FLOOR = Uncertainty(translation=0.008, rotation=0.0005)


@dataclass(frozen=True, kw_only=True, slots=True)
class Refined:
    """Poses after the last round, and what is known of them."""

    poses: dict[int, Matrix4]  #: map_from_scan
    uncertainties: dict[int, Uncertainty]  #: against the fixed scan
    free_space_violation: dict[int, float]  #: by scan, mean over its neighbours, 0..1


def refine_jointly(
    poses: Mapping[int, Matrix4],
    points: Mapping[int, Points],
    workspace: Workspace,
    *,
    fixed: int,
    ties: Sequence[tuple[int, int]],
    progress: Callable[[float], None],
) -> Refined:
    """Linearise and solve in rounds. `points` are downsampled scans for the extents, `ties` pairs to be kept."""
    current = dict(poses)
    settings = workspace.settings.mapping
    rounds = settings.refinement_rounds
    linearized: list[LinearizedPair] = []
    for number in range(rounds + 1):
        level = min(number, len(_DISTANCES) - 1)
        pairs = _pairs(current, points, ties, settings)
        linearized = _linearize(current, pairs, workspace, level=level, check_free_space=number == rounds)
        progress((number + 1) / (rounds + 1))
        if number < rounds and len(current) > 1:
            current = retract(current, solve(list(current), _damped(linearized, current), fixed=fixed))
    return Refined(
        poses=current,
        uncertainties=uncertainties(current, linearized, fixed=fixed),
        free_space_violation=_mean_violations(current, linearized),
    )


def _linearize(
    poses: Mapping[int, Matrix4],
    pairs: Sequence[tuple[int, int]],
    workspace: Workspace,
    *,
    level: int,
    check_free_space: bool,
) -> list[LinearizedPair]:
    """Linearise these pairs (target, source), in their order."""
    sources = defaultdict(list)
    for target, source in pairs:
        sources[target].append((source, poses[source]))
    tasks = [
        LinearizeTask(
            folder=workspace.folder,
            target=(target, poses[target]),
            sources=tuple(near),
            max_correspondence_distance=_DISTANCES[level],
            every=_EVERY[level],
            check_free_space=check_free_space,
        )
        for target, near in sources.items()
    ]
    linearized = {
        (pair.target, pair.source): pair
        for batch in workspace.processes.map_unordered(linearize, tasks)
        for pair in batch
    }
    return [linearized[pair] for pair in pairs]


def uncertainties(
    poses: Mapping[int, Matrix4], linearized: Sequence[LinearizedPair], *, fixed: int
) -> dict[int, Uncertainty]:
    """Invert the point-to-plane Hessian of all scans together, with a floor (Censi, ICRA 2007, for the first part)."""
    result = {fixed: FLOOR}
    if len(poses) < 2:
        return result
    inliers = np.array([pair.equations.num_inliers for pair in linearized])
    squares = np.array([pair.equations.square_residual for pair in linearized])
    variance = float((inliers * squares).sum() / max(inliers.sum(), 1)) * CORRELATED
    blocks = covariances(list(poses), _damped(linearized, poses), fixed=fixed, variance=variance)
    for scan, block in blocks.items():
        # how the sensor's place moves with the twist (rotation, translation) of the pose
        place = np.hstack([-skew(poses[scan][:3, 3]), np.eye(3)])
        result[scan] = Uncertainty(
            translation=float(np.hypot(_worst(place @ block @ place.T), FLOOR.translation)),
            rotation=float(np.hypot(_worst(block[:3, :3]), FLOOR.rotation)),
        )
    return result


def _worst(covariance: Floats) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _pairs(
    poses: Mapping[int, Matrix4],
    points: Mapping[int, Points],
    ties: Sequence[tuple[int, int]],
    settings: MappingSettings,
) -> list[tuple[int, int]]:
    extents = {scan: Extent.of(points[scan], pose) for scan, pose in poses.items()}
    near = likely_pairs(extents, settings, partners=_NEIGHBOURS)
    tied = {(min(pair), max(pair)) for pair in ties if pair[0] in poses and pair[1] in poses}
    return sorted({*near, *tied})


def _damped(linearized: Sequence[LinearizedPair], poses: Mapping[int, Matrix4]) -> list[Factor]:
    """Return the factors, each with a little of itself in every direction (damping): a free scan stays where it is.

    A little as seen from the scan: about an origin that is far away, a turn of the scan looks like a long way, and
    damping that a little would hold the turn fast.
    """
    damped = []
    for pair in linearized:
        information, here = pair.equations.information, np.eye(4)
        here[:3, 3] = poses[pair.source][:3, 3]
        there, back = adjoint(here), adjoint(inverse(here))
        strength = float(np.trace(there.T @ information @ there)) / 6
        damping = _DAMPING * max(strength, 1.0) * (back.T @ back)
        damped.append(
            Factor(
                target=pair.target,
                source=pair.source,
                information=information + damping,
                gradient=pair.equations.gradient,
            )
        )
    return damped


def _mean_violations(poses: Mapping[int, Matrix4], linearized: Sequence[LinearizedPair]) -> dict[int, float]:
    by_scan = defaultdict(list)
    for pair in linearized:
        for scan in (pair.target, pair.source):
            by_scan[scan].append(pair.free_space_violation)
    return {scan: float(np.mean(by_scan[scan])) if by_scan[scan] else 0.0 for scan in poses}
