"""Point-to-plane ICP (paper, Section 3.3.2): the loop that everything else here rests on.

Ours rather than Open3D's because the target's tree and normals are kept between calls, a cancelled job has to
stop between two iterations, and the normal matrix is needed afterwards. The hot parts are SciPy's k-d tree and
NumPy products; one iteration on 30,000 points takes about as long as Open3D's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.cloud.poses import exponential, transformed
from worker.cloud.types import Bools, Floats, Matrix4
from worker.threads import query_threads

_WORTH_A_THREAD = 4000  # points of a query; SciPy starts its threads anew for each


@dataclass(frozen=True, kw_only=True, slots=True)
class Surface:
    """Points with normals and a tree over them: what ICP aligns to."""

    points: Floats  #: (M, 3) metres, target frame
    normals: Floats  #: (M, 3) unit length
    oriented: (
        Bools  #: (M,) whether the normal points to the side that was seen; otherwise its sign is arbitrary
    )
    tree: cKDTree

    @classmethod
    def of(cls, points: NDArray[Any], normals: NDArray[Any], oriented: Bools) -> Surface:
        """Build the tree over points (M, 3), metres."""
        points = points.astype(np.float64)
        return cls(points=points, normals=normals.astype(np.float64), oriented=oriented, tree=cKDTree(points))

    def thinned(self, every: int) -> Surface:
        """One point of so many; the tree stays that of all, so this is something to move, not to be asked."""
        if every == 1:
            return self
        return Surface(
            points=self.points[::every],
            normals=self.normals[::every],
            oriented=self.oriented[::every],
            tree=self.tree,
        )

    def nearest(self, points: Floats, *, within: float = np.inf) -> tuple[Floats, NDArray[np.intp]]:
        """Distance (N,) in metres and index (N,) of the nearest point; inf and M where none is near enough."""
        threads = query_threads() if len(points) > _WORTH_A_THREAD else 1
        distance, index = self.tree.query(points, distance_upper_bound=within, workers=threads)
        return np.asarray(distance, np.float64), np.asarray(index, np.intp)


@dataclass(frozen=True, kw_only=True, slots=True)
class IcpResult:
    """Where ICP ended, in the terms of Open3D and small_gicp."""

    target_from_source: Matrix4
    converged: bool  #: the last step was below the tolerance
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
    tolerance: float = 1e-4,
    soft: bool = False,
    every: int = 1,
    tick: Callable[[], None] = lambda: None,
) -> IcpResult:
    """Minimise the squared distances of the source's points to the tangent planes of their nearest neighbours.

    `start` is target_from_source; `tolerance` ends the loop, in radians and metres of one step. `soft`
    weighs pairs down towards the gate (Tukey's biweight), for wide gates where many are wrong. `every` takes
    one point of so many. `tick` is called before every iteration and may raise to stop the work.
    Pairs that face opposite ways are the two sides of one wall, and are left out.
    """
    points = source.points[::every]
    pose, converged, iterations = start, False, 0
    while iterations < max_iterations and not converged:
        tick()
        iterations += 1
        moved = transformed(points, pose)
        distance, index = target.nearest(moved, within=max_correspondence_distance)
        pair = facing(source, target, pose, index, np.isfinite(distance), every=every)
        if pair.sum() < 6:
            break
        jacobian, residual = _linearised(moved[pair], target, index[pair])
        weighted = jacobian
        if soft:
            weighted = jacobian * ((1 - (distance[pair] / max_correspondence_distance) ** 2) ** 2)[:, None]
        # 1e-9 keeps a scene without constraint in some direction solvable: the step there is zero
        normal_matrix = weighted.T @ jacobian + 1e-9 * len(residual) * np.eye(6)
        step: Floats = -np.linalg.solve(normal_matrix, weighted.T @ residual).astype(np.float64)
        pose = exponential(step) @ pose
        converged = bool(np.abs(step).max() < tolerance)
    return _evaluated(points, target, pose, max_correspondence_distance, converged, iterations)


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
    within: float,
    every: int = 1,
    frame_from_target: Matrix4 | None = None,
) -> NormalEquations:
    """Pairs nearer than `within` metres; twists act in the target's frame, or in the one that is given."""
    moved = transformed(source.points[::every], target_from_source)
    distance, index = target.nearest(moved, within=within)
    pair = facing(source, target, target_from_source, index, np.isfinite(distance), every=every)
    moved, index = moved[pair], index[pair]
    normals = target.normals[index]
    residual = np.einsum("ij,ij->i", moved - target.points[index], normals)
    if frame_from_target is not None:
        moved, normals = transformed(moved, frame_from_target), normals @ frame_from_target[:3, :3].T
    jacobian = np.hstack([np.cross(moved, normals), normals])
    return NormalEquations(
        information=every * (jacobian.T @ jacobian),
        gradient=every * (jacobian.T @ residual),
        num_inliers=every * len(residual),
        square_residual=float(np.mean(residual**2)) if len(residual) else 0.0,
    )


def facing(
    source: Surface,
    target: Surface,
    target_from_source: Matrix4,
    index: NDArray[np.intp],
    paired: Bools,
    *,
    every: int = 1,
) -> Bools:
    """(N,) which pairs (source point, target point `index`) may be one surface: not two sides of one wall."""
    oriented = paired & source.oriented[::every]
    oriented[oriented] = target.oriented[index[oriented]]
    normals = source.normals[::every][oriented] @ target_from_source[:3, :3].T
    same = paired.copy()
    same[oriented] = np.einsum("ij,ij->i", normals, target.normals[index[oriented]]) > 0
    return same


def _linearised(moved: Floats, target: Surface, index: NDArray[np.intp]) -> tuple[Floats, Floats]:
    normals = target.normals[index]
    residual = np.einsum("ij,ij->i", moved - target.points[index], normals)
    return np.hstack([np.cross(moved, normals), normals]), residual


def _evaluated(
    points: Floats, target: Surface, pose: Matrix4, gate: float, converged: bool, iterations: int
) -> IcpResult:
    distance, _ = target.nearest(transformed(points, pose), within=gate)
    inliers = distance[np.isfinite(distance)]
    return IcpResult(
        target_from_source=pose,
        converged=converged,
        iterations=iterations,
        num_inliers=len(inliers),
        fitness=len(inliers) / max(len(points), 1),
        inlier_rmse=float(np.sqrt(np.mean(inliers**2))) if len(inliers) else float("inf"),
    )
