"""Surfaces: points with normals, the side they were seen from and a tree over them; what registration aligns to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.cloud.normals import estimate_normals
from worker.cloud.types import Bools, Floats, Matrix4, Normals, Points
from worker.cloud.voxels import Voxels
from worker.pipeline.registration.settings import RegistrationSettings
from worker.threads import query_threads

_AT_ONCE = 1_000_000  # points whose normals are turned together
_WORTH_A_THREAD = 4000  # points of a query; SciPy starts its threads anew for each
_DEGENERACY_VOXEL, _DEGENERACY_RADIUS = 0.2, 0.5  # metres


@dataclass(frozen=True, kw_only=True, slots=True)
class Surface:
    """Points with normals and a tree over them: what ICP aligns to."""

    points: Floats  #: (M, 3) metres, target frame
    normals: Floats  #: (M, 3) unit length
    oriented: Bools  #: (M,) whether the normal points to the side that was seen; else its sign is arbitrary
    tree: cKDTree

    @classmethod
    def of(cls, points: NDArray[Any], normals: NDArray[Any], oriented: Bools) -> Surface:
        """Build the tree over points (M, 3), metres."""
        points = points.astype(np.float64)
        return cls(points=points, normals=normals.astype(np.float64), oriented=oriented, tree=cKDTree(points))

    def selected(self, rows: slice | Bools | NDArray[np.intp]) -> Surface:
        """Return some of the points with the tree of all: a surface to be moved, not to be queried."""
        return Surface(
            points=self.points[rows], normals=self.normals[rows], oriented=self.oriented[rows], tree=self.tree
        )

    def reflected(self) -> Surface:
        """Return the mirror image: x negated."""
        flip = np.array([-1.0, 1.0, 1.0])
        return Surface.of(self.points * flip, self.normals * flip, self.oriented)

    def nearest(self, points: Floats, *, within: float = np.inf) -> tuple[Floats, NDArray[np.intp]]:
        """Return distance (N,) in metres and index (N,) of the nearest point; inf and M where none is near enough."""
        threads = query_threads() if len(points) > _WORTH_A_THREAD else 1
        distance, index = self.tree.query(points, distance_upper_bound=within, workers=threads)
        return np.asarray(distance, np.float64), np.asarray(index, np.intp)


def surface_of(voxels: Voxels, settings: RegistrationSettings) -> Surface:
    """Make a target of ICP of the voxels: normals of Table 1, turned to the side they were seen from."""
    points = voxels.points
    return Surface.of(points, *oriented_normals(points, voxels.views, settings))


def oriented_normals(
    points: Points, views: NDArray[Any], settings: RegistrationSettings
) -> tuple[Normals, Bools]:
    """Return the normals (M, 3) of points (M, 3), and of each whether it points to the side that was seen.

    `views` (M, 3) are mean directions to the sensors.
    """
    normals = estimate_normals(
        points, radius=settings.normal_radius, max_neighbors=settings.normal_max_neighbors
    )
    oriented = np.empty(len(points), bool)
    for start in range(0, len(points), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        normals[some][np.einsum("ij,ij->i", normals[some], views[some]) < 0] *= -1
        # seen from nowhere known, or from both sides: a board thinner than a voxel
        oriented[some] = np.linalg.norm(views[some], axis=1) > 0.3
    return normals, oriented


def facing(
    source: Surface, target: Surface, target_from_source: Matrix4, index: NDArray[np.intp], paired: Bools
) -> Bools:
    """Tell (N,) which pairs (source point, target point `index`) may be one surface: not two sides of one wall."""
    oriented = paired & source.oriented
    oriented[oriented] = target.oriented[index[oriented]]
    normals = source.normals[oriented] @ target_from_source[:3, :3].T
    same = paired.copy()
    same[oriented] = np.einsum("ij,ij->i", normals, target.normals[index[oriented]]) > 0
    return same


def least_eigenvalue(points: NDArray[Any]) -> float:
    """Return the smallest eigenvalue of the scene's normal matrix per point, without unit; 0 where a motion is free.

    A bare plane leaves three motions free (two slides and a spin), and ICP then answers with whatever it started from.
    Points (N, 3), metres. Normals are estimated over half a metre, for at 10 cm their noise alone looks like structure.
    Lever arms are centred and scaled by their root mean square, so that the number does not depend on the frame or on
    the size of the place. Measured: a plane 0.0000, two planes 0.0002, the real rooms in our tests 0.03 to 0.14. Idea:
    degeneracy of optimisation-based state estimation, Zhang, Kaess and Singh, ICRA 2016; geometrically stable sampling,
    Gelfand et al., 3DIM 2003.
    """
    coarse = Voxels.of(points, size=_DEGENERACY_VOXEL).points.astype(np.float64)
    if len(coarse) < 6:
        return 0.0
    normals = estimate_normals(coarse, radius=_DEGENERACY_RADIUS, max_neighbors=30).astype(np.float64)
    arms = coarse - coarse.mean(axis=0)
    arms /= max(float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))), 1e-9)
    jacobian = np.hstack([np.cross(arms, normals), normals])
    return float(np.linalg.eigvalsh(jacobian.T @ jacobian / len(jacobian))[0])
