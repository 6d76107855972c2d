"""Where the points of a rigid kernel lie: spread in a sphere by repulsion (Thomas et al. 2019, Section 3.1 and Appendix)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

POINTS = 15  #: of a kernel, one of them its centre
MEAN_RADIUS = 1.5  #: of the others, in units of sigma, the distance over which a kernel point acts
SEED = 0

_STEPS, _RATE = 4000, 0.01  #: of the descent; the forces are then below a thousandth of the attraction

Kernel = NDArray[np.float64]


@lru_cache(maxsize=1)
def kernel_points() -> Kernel:
    """Return (15, 3), in units of sigma, the first at the origin."""
    rng = np.random.default_rng(SEED)
    outer = rng.normal(size=(POINTS - 1, 3))
    outer /= np.linalg.norm(outer, axis=1, keepdims=True)
    points = np.concatenate([np.zeros((1, 3)), outer])
    for _ in range(_STEPS):
        points[1:] += _RATE * forces(points)[1:]
    points *= MEAN_RADIUS / np.linalg.norm(points[1:], axis=1).mean()
    points.setflags(write=False)
    return points


def forces(points: Kernel) -> Kernel:
    """Return what pulls each of (n, 3) to the origin, by 2 |x|, and off each other, by 1 / distance squared."""
    apart = points[:, None] - points  # (n, n, 3)
    distances = np.linalg.norm(apart, axis=2) + np.eye(len(points))
    pushed: Kernel = (apart / distances[:, :, None] ** 3).sum(axis=1)
    return pushed - 2 * points
