"""Point-to-plane ICP (paper, Section 3.3.2): the loop that everything else here rests on.

Ours rather than Open3D's because the target's tree and normals are kept between calls, a cancelled job has to
stop between two iterations, and the normal matrix is needed afterwards. The hot parts are SciPy's k-d tree and
NumPy products; one iteration on 30,000 points takes about as long as Open3D's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.poses import exponential, transformed
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.registration.surface import Surface, facing

_CONVERGED = 1e-4  # radians and metres of one step


@dataclass(frozen=True, kw_only=True, slots=True)
class IcpResult:
    """Where ICP ended, in the terms of Open3D and small_gicp."""

    target_from_source: Matrix4  #: (4, 4) rigid
    converged: bool  #: the last step was below `_CONVERGED`
    iterations: int
    num_inliers: int
    fitness: float  #: inliers / source points, 0..1
    inlier_rmse: float  #: metres, point to point


def icp(
    source: Surface,
    target: Surface,
    start: Matrix4,
    *,
    max_correspondence_distance: float,
    max_iterations: int = 30,
    robust: bool = False,
    every: int = 1,
    tick: Callable[[], None] = lambda: None,
) -> IcpResult:
    """Minimise the squared distances of the source's points to the tangent planes of their nearest neighbours.

    `start` is target_from_source; a step below `_CONVERGED` ends the loop. `robust` weighs pairs
    by Tukey's biweight kernel, which is 0 at the correspondence distance: for wide ones, where many pairs are wrong.
    `every` takes one point of so many. `tick` is called before every iteration and may raise to stop the work. Pairs
    that face opposite ways are the two sides of one wall, and are left out.
    """
    source = source.selected(np.s_[::every])
    pose, converged, iterations = start, False, 0
    while iterations < max_iterations and not converged:
        tick()
        iterations += 1
        points, index, distance = _correspondences(source, target, pose, max_correspondence_distance)
        if len(points) < 6:
            break
        weights = (1 - (distance / max_correspondence_distance) ** 2) ** 2 if robust else None
        step = _step(*_linearized(points, target, index), weights)
        pose = exponential(step) @ pose
        converged = bool(np.abs(step).max() < _CONVERGED)
    distance, _ = target.nearest(transformed(source.points, pose), within=max_correspondence_distance)
    inliers = distance[np.isfinite(distance)]
    return IcpResult(
        target_from_source=pose,
        converged=converged,
        iterations=iterations,
        num_inliers=len(inliers),
        fitness=len(inliers) / max(len(source.points), 1),
        inlier_rmse=float(np.sqrt(np.mean(inliers**2))) if len(inliers) else float("inf"),
    )


def _step(jacobian: Floats, residual: Floats, weights: Floats | None) -> Floats:
    """Solve the normal equations of (K, 6) and (K,), with (K,) weights if given: the twist (6,) of one iteration."""
    weighted = jacobian if weights is None else jacobian * weights[:, None]
    # 1e-9 keeps a degenerate scene solvable: the step in a free direction is zero
    normal_matrix = weighted.T @ jacobian + 1e-9 * len(residual) * np.eye(6)
    step: Floats = -np.linalg.solve(normal_matrix, weighted.T @ residual).astype(np.float64)
    return step


@dataclass(frozen=True, kw_only=True, slots=True)
class NormalEquations:
    """The point-to-plane problem at one pose: a small twist d of the source costs d'Hd + 2g'd more.

    Twists are (rotation, translation) about the origin of the frame that everything is given in.
    """

    information: Floats  #: (6, 6) H, sum of the outer products of the Jacobian's rows; divide by sigma^2
    gradient: Floats  #: (6,) g
    num_inliers: int
    square_residual: float  #: square metres, mean of the squared distances to the tangent planes


def normal_equations(
    source: Surface,
    target: Surface,
    target_from_source: Matrix4,
    *,
    max_correspondence_distance: float,
    every: int = 1,
    frame_from_target: Matrix4 | None = None,
) -> NormalEquations:
    """Linearise over the pairs that ICP would use; twists act in the target's frame, or in the one that is given."""
    source = source.selected(np.s_[::every])
    points, index, _ = _correspondences(source, target, target_from_source, max_correspondence_distance)
    jacobian, residual = _linearized(points, target, index, frame_from_target)
    return NormalEquations(
        information=every * (jacobian.T @ jacobian),
        gradient=every * (jacobian.T @ residual),
        num_inliers=every * len(residual),
        square_residual=float(np.mean(residual**2)) if len(residual) else 0.0,
    )


def _correspondences(
    source: Surface, target: Surface, target_from_source: Matrix4, within: float
) -> tuple[Floats, NDArray[np.intp], Floats]:
    """Return points (K, 3) of the source in the target's frame, and index (K,) and distance (K,) of their partners."""
    points = transformed(source.points, target_from_source)
    distance, index = target.nearest(points, within=within)
    paired = facing(source, target, target_from_source, index, np.isfinite(distance))
    return points[paired], index[paired], distance[paired]


def _linearized(
    points: Floats, target: Surface, index: NDArray[np.intp], frame_from_target: Matrix4 | None = None
) -> tuple[Floats, Floats]:
    """Return Jacobian (K, 6) and residual (K,) of the distances to the tangent planes."""
    normals = target.normals[index]
    residual = np.einsum("ij,ij->i", points - target.points[index], normals)
    if frame_from_target is not None:
        points, normals = transformed(points, frame_from_target), normals @ frame_from_target[:3, :3].T
    return np.hstack([np.cross(points, normals), normals]), residual
