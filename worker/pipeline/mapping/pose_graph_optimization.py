"""Least squares over the poses of many scans, with the wrong registrations outvoted, not averaged in.

Everything is linearised in one frame, that of the map: a scan's pose T becomes exp(d) T, and a factor between two scans
costs u'Hu + 2g'u with u = d_source - d_target. Registrations of a pose graph and point pairs of a multi-view refinement
are both such factors. Robust weights by graduated non-convexity with the Geman-McClure loss (Yang et al., RA-L 2020).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from worker.cloud.poses import adjoint, difference, exponential, inverse
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.registration.scan_to_scan import PairResult

Poses = Mapping[int, Matrix4]  #: map_from_scan by index of the scan

_ANNEALING = 1.4  # by which the loss is sharpened from step to step
_STEPS_AT_END = 5


@dataclass(frozen=True, kw_only=True, slots=True)
class Factor:
    """What two scans ask of each other."""

    target: int
    source: int
    information: Floats  #: (6, 6) H, map frame, without unit until divided by sigma^2
    gradient: Floats  #: (6,) g


def retract(poses: Poses, steps: Mapping[int, Floats]) -> dict[int, Matrix4]:
    """Return each pose after its step (6,)."""
    return {scan: exponential(steps[scan]) @ pose if scan in steps else pose for scan, pose in poses.items()}


def solve(scans: Sequence[int], factors: Sequence[Factor], *, fixed: int) -> dict[int, Floats]:
    """Return the step (6,) of every scan but the fixed one that makes the sum of all factors least."""
    matrix, right = _system(scans, factors, fixed)
    solution = scipy.sparse.linalg.spsolve(matrix.tocsc(), right)
    free = [scan for scan in scans if scan != fixed]
    return dict(zip(free, np.asarray(solution).reshape(-1, 6), strict=True))


def covariances(
    scans: Sequence[int], factors: Sequence[Factor], *, fixed: int, variance: float
) -> dict[int, Floats]:
    """Return the (6, 6) of each free scan's step, every other being unknown too; `variance` is of one pair, m^2."""
    matrix, _ = _system(scans, factors, fixed)
    inverted = np.linalg.inv(matrix.toarray()) * variance
    free = [scan for scan in scans if scan != fixed]
    return {scan: inverted[6 * row : 6 * row + 6, 6 * row : 6 * row + 6] for row, scan in enumerate(free)}


def pose_graph_factors(poses: Poses, edges: Sequence[PairResult], weights: Floats) -> list[Factor]:
    """Return each registration as a factor at these poses."""
    return [_factor(poses, edge, weight) for edge, weight in zip(edges, weights, strict=True)]


def residual(poses: Poses, edge: PairResult, settings: MappingSettings) -> float:
    """Measure how far a registration is from the poses: 1 where it is off by as much as a loop may be."""
    metres, radians = difference(edge.target_from_source, inverse(poses[edge.target]) @ poses[edge.source])
    return float(np.hypot(metres / settings.loop_distance, radians / settings.loop_angle))


def optimize(
    poses: Poses, edges: Sequence[PairResult], *, fixed: int, settings: MappingSettings
) -> tuple[dict[int, Matrix4], Floats]:
    """Find poses on which as many registrations as possible agree, and the weight (E,) of each, 0..1.

    Begins with nearly every registration heard and ends with those outvoted that are far from all others.
    """
    scans, current = list(poses), dict(poses)
    weights = trust = np.array([edge.confidence for edge in edges])
    if len(scans) < 2:
        return current, weights
    squares = _squares(current, edges, settings)
    softness = max(2 * float(squares.max(initial=0.0)), 1.0)
    left = _STEPS_AT_END
    while left:
        weights = trust * (softness / (squares + softness)) ** 2
        factors = pose_graph_factors(current, edges, weights)
        current = retract(current, solve(scans, factors, fixed=fixed))
        squares = _squares(current, edges, settings)
        left -= softness == 1.0
        softness = max(softness / _ANNEALING, 1.0)
    return current, weights


def _squares(poses: Poses, edges: Sequence[PairResult], settings: MappingSettings) -> Floats:
    return np.array([residual(poses, edge, settings) ** 2 for edge in edges])


def _factor(poses: Poses, edge: PairResult, weight: float) -> Factor:
    target = poses[edge.target]
    wanted = target @ edge.target_from_source @ inverse(poses[edge.source])
    twist = np.r_[Rotation.from_matrix(wanted[:3, :3]).as_rotvec(), wanted[:3, 3]]
    # damping: a direction that the pair leaves free is held a little, so that every graph has a solution
    damped = edge.information + 1e-6 * np.trace(edge.information) / 6 * np.eye(6)
    back = adjoint(inverse(target))
    information = weight * (back.T @ damped @ back)
    return Factor(
        target=edge.target, source=edge.source, information=information, gradient=-information @ twist
    )


def _loose(scans: Sequence[int], factors: Sequence[Factor], fixed: int) -> list[int]:
    """Return the scans that no chain of factors ties to the fixed one: they are held where they are, and are unsure."""
    row_of = {scan: row for row, scan in enumerate(scans)}
    ends = ([row_of[factor.target] for factor in factors], [row_of[factor.source] for factor in factors])
    graph = scipy.sparse.csr_array((np.ones(len(factors)), ends), shape=(len(scans), len(scans)))
    _, labels = connected_components(graph, directed=False)
    return [scan for scan in scans if labels[row_of[scan]] != labels[row_of[fixed]]]


def _system(
    scans: Sequence[int], factors: Sequence[Factor], fixed: int
) -> tuple[scipy.sparse.coo_array, Floats]:
    row_of = {scan: row for row, scan in enumerate(scan for scan in scans if scan != fixed)}
    right = np.zeros(6 * len(row_of))
    rows, columns, blocks = [], [], []
    for factor in factors:
        ends = [(row_of.get(factor.source), 1.0), (row_of.get(factor.target), -1.0)]
        for a, sign in ends:
            if a is None:
                continue
            right[6 * a : 6 * a + 6] -= sign * factor.gradient
            for b, other in ends:
                if b is not None:
                    rows.append(a)
                    columns.append(b)
                    blocks.append(sign * other * factor.information)
    for scan in _loose(scans, factors, fixed):
        rows.append(row_of[scan])
        columns.append(row_of[scan])
        blocks.append(np.eye(6))
    inner = np.arange(6)
    row = (6 * np.array(rows)[:, None, None] + inner[None, :, None]) + np.zeros((1, 1, 6), int)
    column = (6 * np.array(columns)[:, None, None] + inner[None, None, :]) + np.zeros((1, 6, 1), int)
    matrix = scipy.sparse.coo_array(
        (np.stack(blocks).ravel(), (row.ravel(), column.ravel())), shape=(len(right), len(right))
    )
    return matrix, right
