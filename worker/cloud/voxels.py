"""Voxels: many points averaged to one in each cell of a regular grid (paper, Section 3.3.3).

The grid is anchored at the frame's origin, not at the cloud's corner as Open3D does it, so that two maps in
one frame are sampled by the same cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Colors, Points
from worker.cloud.voxel_keys import BITS, packed, rows_of
from worker.errors import MapFailed

_AT_ONCE = 2_000_000  # points that are sorted together; a scan may have 50 million


@dataclass(frozen=True, kw_only=True, slots=True)
class Voxels:
    """Running sums of the points in each cell; two can be merged without going back to the points."""

    size: float  #: metres
    keys: NDArray[np.int64]  #: (M,) packed cell indices, ascending
    counts: NDArray[np.int64]  #: (M,) points summed
    sums: NDArray[np.float64]  #: (M, 6) x y z, direction to the sensor; (M, 9) with red, green, blue behind

    @classmethod
    def of(
        cls,
        points: NDArray[Any],
        *,
        size: float,
        origin: NDArray[Any] | None = None,
        colors: Colors | None = None,
    ) -> Voxels:
        """Sort points (N, 3), metres, into cells of `size` metres; what is given beside them is averaged too.

        `origin` (3,) is where they were seen from, in their frame. Raises MapFailed for a point that is farther
        from the frame's origin than the cells can count.
        """
        columns = [] if colors is None else [colors]
        pieces = (slice(start, start + _AT_ONCE) for start in range(0, len(points), _AT_ONCE))
        sums = (cls._of_piece(points[at], size, origin, [column[at] for column in columns]) for at in pieces)
        return fused(sums) or cls._of_piece(points, size, origin, columns)

    @classmethod
    def _of_piece(
        cls, points: NDArray[Any], size: float, origin: NDArray[Any] | None, columns: list[NDArray[Any]]
    ) -> Voxels:
        keys = cls.keys_of(points, size=size)
        values = np.hstack([points, _directions(points, origin), *columns]).astype(np.float64)
        return _summed(size, keys, np.ones(len(keys), np.int64), values)

    @staticmethod
    def keys_of(points: NDArray[Any], *, size: float) -> NDArray[np.int64]:
        """Return (N,) the packed index of the cell that each point (N, 3) lies in; raises MapFailed as `of` does."""
        cells = np.floor(points / size).astype(np.int64)
        limit = 1 << (BITS - 1)
        if len(cells) and (cells.min() < -limit or cells.max() >= limit):
            farthest = float(np.abs(points).max()) / 1000
            raise MapFailed(f"a point lies {farthest:.0f} km from the map's origin; check the pose priors")
        return packed(cells)

    def merged(self, other: Voxels) -> Voxels:
        """Add both; colours are kept only where both have them. Takes no more memory than both and their sum."""
        width = min(self.sums.shape[1], other.sums.shape[1])
        sizes = [
            len(one.keys) + len(more.keys) - _shared(one.keys, more.keys) for one, more in _runs(self, other)
        ]
        keys, counts = np.empty(sum(sizes), np.int64), np.empty(sum(sizes), np.int64)
        sums = np.empty((sum(sizes), width))
        end = 0
        for (one, more), size in zip(_runs(self, other), sizes, strict=True):
            here = slice(end, end := end + size)
            run = Voxels.added([one, more])
            keys[here], counts[here], sums[here] = run.keys, run.counts, run.sums
        return Voxels(size=self.size, keys=keys, counts=counts, sums=sums)

    @classmethod
    def added(cls, parts: Sequence[Voxels]) -> Voxels:
        """Add all parts, of which there is at least one, at once; colours are kept only where all have them."""
        width = min(part.sums.shape[1] for part in parts)
        return _summed(
            parts[0].size,
            np.concatenate([part.keys for part in parts]),
            np.concatenate([part.counts for part in parts]),
            np.concatenate([part.sums[:, :width] for part in parts]),
        )

    @property
    def points(self) -> Points:
        """(M, 3) float32, metres: the mean of each cell's points."""
        return self._means(slice(0, 3), np.dtype(np.float32))

    @property
    def views(self) -> NDArray[np.float64]:
        """(M, 3) mean direction to the sensors that saw the cell; 0 where no origin was given."""
        return self._means(slice(3, 6), np.dtype(np.float64))

    @property
    def colors(self) -> Colors | None:
        """(M, 3) uint8, or None where no colours were given."""
        if self.sums.shape[1] == 6:
            return None
        return self._means(slice(6, 9), np.dtype(np.uint8))

    def run(self, first: int, last: int) -> Voxels:
        """Return the cells in these rows, without a copy."""
        return Voxels(
            size=self.size,
            keys=self.keys[first:last],
            counts=self.counts[first:last],
            sums=self.sums[first:last],
        )

    def _means(self, columns: slice, kind: np.dtype[Any]) -> NDArray[Any]:
        """Return (M, 3) the means of three columns, rounded where they become whole numbers; some at a time."""
        means = np.empty((len(self.keys), 3), kind)
        for start in range(0, len(self.keys), _AT_ONCE):
            at = slice(start, start + _AT_ONCE)
            exact = self.sums[at, columns] / self.counts[at, None]
            means[at] = np.rint(exact) if kind.kind == "u" else exact
        return means


def _directions(points: NDArray[Any], origin: NDArray[Any] | None) -> NDArray[Any]:
    if origin is None:
        return np.zeros(points.shape)
    away = origin - points
    unit: NDArray[Any] = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return unit


def _summed(
    size: float, keys: NDArray[np.int64], counts: NDArray[np.int64], values: NDArray[np.float64]
) -> Voxels:
    if not len(keys):
        return Voxels(size=size, keys=keys, counts=counts, sums=values)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    return Voxels(
        size=size,
        keys=keys[starts],
        counts=np.add.reduceat(counts[order], starts),
        sums=np.add.reduceat(values[order], starts, axis=0),
    )


def _runs(one: Voxels, other: Voxels) -> Iterator[tuple[Voxels, Voxels]]:
    """Yield both, cut at the same keys into runs of about `_AT_ONCE` cells."""
    longer = one.keys if len(one.keys) >= len(other.keys) else other.keys
    cuts = longer[_AT_ONCE::_AT_ONCE]
    of_one, of_other = (
        pairwise([0, *np.searchsorted(part.keys, cuts).tolist(), len(part.keys)]) for part in (one, other)
    )
    for (first, last), (begin, end) in zip(of_one, of_other, strict=True):
        yield one.run(first, last), other.run(begin, end)


def _shared(keys: NDArray[np.int64], others: NDArray[np.int64]) -> int:
    """Count the keys that are in both, each ascending and once."""
    return int((rows_of(others, keys) >= 0).sum())


def fused(parts: Iterable[Voxels]) -> Voxels | None:
    """Merge all parts, a few of which are held at once; None where there is none."""
    return next(merged_runs(parts, most=None), None)


def merged_runs(parts: Iterable[Voxels], *, most: int | None) -> Iterator[Voxels]:
    """Merge parts as they come; yield what was merged whenever more than `most` voxels are held, and the rest.

    All that is yielded but the last has more than half as many voxels. Sums of like size are merged, as in a merge sort: each voxel is sorted log(parts) times, not once a part.
    """
    stack: list[Voxels] = []
    for part in parts:
        stack.append(part)
        del part  # held by the stack alone from here on
        while len(stack) > 1 and len(stack[-2].keys) < 2 * len(stack[-1].keys):
            _merge_last(stack)
        if most is not None and sum(len(held.keys) for held in stack) > most:
            _merge_all(stack)
            if len(stack[0].keys) > most // 2:  # less where scans saw the same
                yield stack.pop()
    if stack:
        _merge_all(stack)
        yield stack.pop()


def _merge_all(stack: list[Voxels]) -> None:
    while len(stack) > 1:
        _merge_last(stack)


def _merge_last(stack: list[Voxels]) -> None:
    last = stack.pop()
    stack[-1] = stack[-1].merged(last)


def merged_in_order(parts: Sequence[Voxels]) -> Voxels:
    """Merge all parts, summed in an order that depends on their places alone.

    `worker.pipeline.mapping.fusion.fuse` merges by size, so that one changed scan may change how others are summed, and
    the last bit of a mean with it. Here untouched voxels come out bit for bit the same. Raises ValueError for none.
    """
    if not parts:
        raise ValueError("no scan to fuse")
    if len(parts) == 1:
        return parts[0]
    middle = len(parts) // 2
    return merged_in_order(parts[:middle]).merged(merged_in_order(parts[middle:]))
