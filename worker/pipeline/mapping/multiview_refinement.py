"""Joint refinement: all scans moved together until their points meet, then what each pose is worth.

A pose graph averages registrations; here the points themselves are asked again, every scan against all its neighbours
at once (multi-view point-to-plane ICP; Pulli, 3DIM 1999), so that a corridor's ends are held by everything between.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import inverse
from worker.cloud.types import Floats, Matrix4, Points
from worker.pipeline.mapping.pair_selection import Extent, likely_pairs
from worker.pipeline.mapping.pose_graph_optimization import Factor, adjoint, covariances, moved, solve
from worker.pipeline.mapping.settings import MapSettings
from worker.pipeline.mapping.tasks import Folder, LinearizedPair, LinearizeTask, linearise
from worker.pipeline.registration.results import Uncertainty
from worker.processes import Processes

_GATES = (0.15, 0.1, 0.05)  # metres, of the rounds; the last one stays
_EVERY = (4, 4, 2)  # points of each scan, likewise
_NEIGHBOURS = 6  # that a scan is refined against

#: Pairs of points are no independent witnesses: neighbours share a range error and a surface that is not quite plane.
#: So many count as one; set so that errors of simulated scans are of the size that is told.
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
    *,
    fixed: int,
    also: Sequence[tuple[int, int]],
    folder: Folder,
    processes: Processes,
    settings: MapSettings,
    progress: Callable[[float], None],
) -> Refined:
    """Rounds of linearising and solving. `points` are thinned scans for the extents, `also` pairs to be kept."""
    current = dict(poses)
    rounds = settings.refinement_rounds
    terms: list[LinearizedPair] = []
    for number in range(rounds + 1):
        level = min(number, len(_GATES) - 1)
        pairs = _pairs(current, points, also, settings)
        terms = linearised(
            current,
            pairs,
            folder,
            processes,
            within=_GATES[level],
            every=_EVERY[level],
            glancing=number == rounds,
        )
        progress((number + 1) / (rounds + 1))
        if number < rounds and len(current) > 1:
            steps = solve(list(current), _held(terms, current), fixed=fixed)
            current = moved(current, steps)
    return Refined(
        poses=current,
        uncertainties=uncertainties(current, terms, fixed=fixed),
        free_space_violation=_seen_through(current, terms),
    )


def linearised(
    poses: Mapping[int, Matrix4],
    pairs: Sequence[tuple[int, int]],
    folder: Folder,
    processes: Processes,
    *,
    within: float,
    every: int,
    glancing: bool,
) -> list[LinearizedPair]:
    """The terms of these pairs (target, source), in their order."""
    sources = defaultdict(list)
    for target, source in pairs:
        sources[target].append((source, poses[source]))
    tasks = [
        LinearizeTask(
            folder=folder,
            target=(target, poses[target]),
            sources=tuple(near),
            within=within,
            every=every,
            glancing=glancing,
        )
        for target, near in sources.items()
    ]
    found = {
        (each.term.target, each.term.source): each
        for batch in processes.each(linearise, tasks)
        for each in batch
    }
    return [found[pair] for pair in pairs]


def uncertainties(
    poses: Mapping[int, Matrix4], terms: Sequence[LinearizedPair], *, fixed: int
) -> dict[int, Uncertainty]:
    """From the point-to-plane Hessian of all scans together, with a floor (Censi, ICRA 2007, for the first part)."""
    found = {fixed: FLOOR}
    if len(poses) < 2:
        return found
    inliers = np.array([term.num_inliers for term in terms])
    squares = np.array([term.square_residual for term in terms])
    variance = float((inliers * squares).sum() / max(inliers.sum(), 1)) * CORRELATED
    blocks = covariances(list(poses), _held(terms, poses), fixed=fixed, variance=variance)
    for scan, block in blocks.items():
        x, y, z = poses[scan][:3, 3]
        # how the sensor's place moves with the twist (rotation, translation) of the pose
        place = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
        found[scan] = Uncertainty(
            translation=float(np.hypot(_worst(place @ block @ place.T), FLOOR.translation)),
            rotation=float(np.hypot(_worst(block[:3, :3]), FLOOR.rotation)),
        )
    return found


def _worst(covariance: Floats) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _pairs(
    poses: Mapping[int, Matrix4],
    points: Mapping[int, Points],
    also: Sequence[tuple[int, int]],
    settings: MapSettings,
) -> list[tuple[int, int]]:
    extents = {scan: Extent.of(points[scan], pose) for scan, pose in poses.items()}
    near = likely_pairs(extents, settings.model_copy(update={"partners": _NEIGHBOURS}))
    known = {(min(pair), max(pair)) for pair in also if pair[0] in poses and pair[1] in poses}
    return sorted({*near, *known})


def _held(terms: Sequence[LinearizedPair], poses: Mapping[int, Matrix4]) -> list[Factor]:
    """The terms, each with a little of itself in every direction: one that nobody holds stays where it is.

    A little as seen from the scan: about an origin that is far away, a turn of the scan looks like a long way, and
    holding that a little would hold the turn fast.
    """
    held = []
    for each in terms:
        term, here = each.term, np.eye(4)
        here[:3, 3] = poses[term.source][:3, 3]
        there, back = adjoint(here), adjoint(inverse(here))
        strength = float(np.trace(there.T @ term.information @ there)) / 6
        little = 1e-6 * max(strength, 1.0) * (back.T @ back)
        held.append(
            Factor(
                target=term.target,
                source=term.source,
                information=term.information + little,
                gradient=term.gradient,
            )
        )
    return held


def _seen_through(poses: Mapping[int, Matrix4], terms: Sequence[LinearizedPair]) -> dict[int, float]:
    by_scan = defaultdict(list)
    for each in terms:
        for scan in (each.term.target, each.term.source):
            by_scan[scan].append(each.free_space_violation)
    return {scan: float(np.mean(by_scan[scan])) if by_scan[scan] else 0.0 for scan in poses}
