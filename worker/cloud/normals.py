"""Surface normals by principal components of each point's neighbourhood (paper, Table 1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.cloud.blocks import blocks_of
from worker.cloud.types import Bools, Floats, Normals
from worker.threads import query_threads

SPARSE = 8  #: neighbours below which a wider look is taken
WIDER = 3.0  #: times the radius
AT_ONCE = 100_000  #: points that are looked at together
_FEWEST = 3  # points of a plane, itself among them

#: Pairs of axes whose products make a covariance, row by row of its upper half.
_PRODUCTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def estimate_normals(points: NDArray[Any], *, radius: float, max_neighbors: int) -> Normals:
    """Estimate unit normals (N, 3) of points (N, 3), metres, from at most `max_neighbors` within `radius` metres.

    The nearest are taken, the point itself among them. Where fewer than `SPARSE` others lie so near, the radius is three
    times as wide: five metres away a standing scanner leaves 15 cm between its points, and three of them make no plane
    but noise, which drags ICP metres away. The sign is arbitrary; of fewer than three points the normal is the z axis.
    A large cloud is looked at in blocks with what lies around each: memory beside the answer does not grow with it, and
    trees and points of a block stay in the processor's cache.
    """
    normals = np.empty((len(points), 3), np.float32)
    for block in blocks_of(points, most=AT_ONCE, reach=WIDER * radius):
        here = points[block.rows].astype(np.float64)
        normals[block.rows[block.own]] = _of_block(here, block.own, radius, max_neighbors)
    return normals


def _of_block(points: Floats, own: NDArray[np.intp], radius: float, max_neighbors: int) -> Floats:
    """Return the normals (J, 3) of the points at these places (J,) among all (K, 3)."""
    if not len(own):
        return np.empty((0, 3))
    order = _along_the_tree(tree := cKDTree(points), own)
    normals = np.empty((len(points), 3))
    normals[order], sparse = _looked_up(tree, order, radius, max_neighbors)
    if sparse.any():
        normals[order[sparse]], _ = _looked_up(tree, order[sparse], WIDER * radius, max_neighbors)
    return normals[own]


def _along_the_tree(tree: cKDTree, own: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return these rows as they lie in the leaves of the tree: the next point's neighbours are then mostly at hand."""
    wanted = np.zeros(tree.n, bool)
    wanted[own] = True
    leaves = np.asarray(tree.indices, np.intp)
    rows: NDArray[np.intp] = leaves[wanted[leaves]]
    return rows


def _looked_up(
    tree: cKDTree, rows: NDArray[np.intp], radius: float, max_neighbors: int
) -> tuple[Floats, Bools]:
    """Return the normals (R, 3) of these points of the tree, and (R,) where too few lie within the radius."""
    most = min(max(max_neighbors, SPARSE + 1), tree.n)
    points = np.asarray(tree.data)
    distance, index = tree.query(
        points[rows], k=np.arange(1, most + 1), distance_upper_bound=radius, workers=query_threads()
    )
    near = np.isfinite(distance)
    sparse = near.sum(axis=1) <= SPARSE
    near[:, max_neighbors:] = False
    counts = near.sum(axis=1)
    offsets = points[index[near]] - np.repeat(points[rows], counts, axis=0)
    return _least_axis(_covariances(offsets, counts), counts >= _FEWEST), sparse


def _covariances(offsets: Floats, counts: NDArray[np.intp]) -> Floats:
    """Return (R, 6) the upper halves of the covariances of so many (R,) offsets each, which lie end to end."""
    starts = np.r_[0, np.cumsum(counts)[:-1]]
    means = np.add.reduceat(offsets, starts, axis=0) / counts[:, None]
    columns = []
    for i, j in _PRODUCTS:
        squares = np.add.reduceat(offsets[:, i] * offsets[:, j], starts) / counts
        columns.append(squares - means[:, i] * means[:, j])
    return np.stack(columns, axis=1)


def _least_axis(covariances: Floats, known: Bools) -> Floats:
    """Return (R, 3) the unit eigenvectors of the least eigenvalues; the z axis where that is not `known` (R,).

    The eigenvalue is the root of a cubic by its cosine, and the vector is at right angles to two rows of what is left
    (Eberly, A Robust Eigensolver for 3 x 3 Symmetric Matrices, 2014), as Open3D has it. Where all of that vanishes, as
    of points on a line, LAPACK says.
    """
    largest = np.abs(covariances).max(axis=1)
    scale = np.where(largest > 0, largest, 1.0)
    xx, xy, xz, yy, yz, zz = (covariances / scale[:, None]).T
    least = _least_eigenvalue(xx, xy, xz, yy, yz, zz)
    rows = np.stack([xx - least, xy, xz, xy, yy - least, yz, xz, yz, zz - least], axis=1).reshape(-1, 3, 3)
    crosses = np.cross(rows[:, [0, 0, 1]], rows[:, [1, 2, 2]])
    lengths = np.einsum("rij,rij->ri", crosses, crosses)
    longest = lengths.argmax(axis=1)
    each = np.arange(len(covariances))
    length = np.sqrt(lengths[each, longest])
    unclear = length < 1e-6
    vectors: Floats = crosses[each, longest] / np.where(unclear, 1.0, length)[:, None]
    if unclear.any():
        vectors[unclear] = np.linalg.eigh(_whole(covariances[unclear]))[1][:, :, 0]
    vectors[~known] = (0.0, 0.0, 1.0)
    return vectors


def _least_eigenvalue(xx: Floats, xy: Floats, xz: Floats, yy: Floats, yz: Floats, zz: Floats) -> Floats:
    """Return (R,) the least eigenvalue of each symmetric matrix."""
    mean = (xx + yy + zz) / 3
    x, y, z = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((x * x + y * y + z * z + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    determinant = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
    cosine = determinant / np.maximum(2 * spread**3, 1e-300)
    angle = np.arccos(np.clip(cosine, -1, 1)) / 3
    least: Floats = mean + 2 * spread * np.cos(angle + 2 * np.pi / 3)
    return least


def _whole(covariances: Floats) -> Floats:
    """Return (R, 3, 3) of upper halves (R, 6)."""
    return covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
