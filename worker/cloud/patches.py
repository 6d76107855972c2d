"""Patches: a tile's points brought to one fixed number (paper, Section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Points


@dataclass(frozen=True, kw_only=True, slots=True)
class Patch:
    """A patch, kept as its distinct points and how often each is repeated.

    A max-pool cannot tell a point from its copies, so a network of that kind runs on `distinct` alone; only
    the centroid needs the repeats. `padded()` writes the patch out as the paper stores it (Table A1).
    """

    distinct: Points  #: (m, 3) float32, metres, relative to the tile's centre, in a seeded order
    repeats: NDArray[np.int32]  #: (m,) how often each is taken; sums to `size`
    size: int  #: points of the padded patch

    @property
    def centroid(self) -> Points:
        """(3,) float32, mean of the padded patch."""
        weighted = self.repeats.astype(np.float64) @ self.distinct.astype(np.float64)
        return (weighted / self.size).astype(np.float32)

    def padded(self) -> Points:
        """Return (size, 3) float32, the distinct points over and over in their order."""
        return self.points_at(np.arange(self.size))

    def points_at(self, places: NDArray[np.int64]) -> Points:
        """Return (k, 3) float32, the points at these places (k,) of the padded patch."""
        return self.distinct[places % len(self.distinct)]


def patch(points: Points, *, size: int = 4096, seed: int) -> Patch:
    """Bring `points` (n, 3), metres, tile-centre frame, to `size` points.

    More than `size` points go through farthest point sampling from a start that the seed chooses. With fewer,
    farthest point sampling would keep every point, so none is run: a seeded order, repeated from its head
    until the patch is full. Raises ValueError for an empty cloud.
    """
    if len(points) == 0:
        raise ValueError("a patch needs at least one point")
    rng = np.random.default_rng(seed)
    if len(points) > size:
        chosen = farthest_points(points, size, start=int(rng.integers(len(points))))
    else:
        chosen = rng.permutation(len(points))
    distinct = np.ascontiguousarray(points[chosen], dtype=np.float32)
    repeats = np.full(len(distinct), size // len(distinct), dtype=np.int32)
    repeats[: size % len(distinct)] += 1
    return Patch(distinct=distinct, repeats=repeats, size=size)


def farthest_points(points: Points, count: int, *, start: int) -> NDArray[np.int64]:
    """Return indices (count,) of farthest point sampling; `start` (0..n-1) chooses the point that it begins with.

    `fpsample` does it with a bucketed k-d tree (3-9 ms a tile) and counts `start` in that tree's order, plain
    NumPy in the cloud's own. From their first point on, both choose alike up to ties. NumPy, some twenty times
    slower, is for machines that only train and may lack `fpsample`.
    """
    try:
        from fpsample import bucket_fps_kdline_sampling  # noqa: PLC0415 (optional where only training runs)
    except ImportError:
        return farthest_points_numpy(points, count, start=start)
    chosen = bucket_fps_kdline_sampling(points, count, h=_tree_height(len(points)), start_idx=start)
    return np.asarray(chosen, dtype=np.int64)


def _tree_height(n: int) -> int:
    """Return the height of the k-d tree: buckets of some dozens of points, within what fpsample advises (3 to 9)."""
    return int(np.clip(np.log2(n) - 5, 3, 9))


def farthest_points_numpy(points: Points, count: int, *, start: int) -> NDArray[np.int64]:
    """Return indices (count,) as `farthest_points` does, `start` in the cloud's own order; no library but NumPy."""
    chosen = np.empty(count, dtype=np.int64)
    nearest = np.full(len(points), np.inf, dtype=np.float32)
    for i in range(count):
        chosen[i] = start
        offsets = points - points[start]
        np.minimum(nearest, np.einsum("ij,ij->i", offsets, offsets), out=nearest)
        start = int(nearest.argmax())
    return chosen
