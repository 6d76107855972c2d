"""Fusing: many scans to one point a voxel, also where the sums of all voxels are more than memory may hold.

Sums are merged as scans come. Whenever they take more than they may, they are written to a file as one run of ascending
keys, and a new one begins. At the end the runs are added up key range by key range (an external merge sort; Knuth, The
Art of Computer Programming, volume 3, 5.4). Keys ascend along x first, so that a range of keys is a slab of the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Colors, Floats, Normals, Points
from worker.cloud.voxels import Voxels, merged_runs

MEMORY_BYTES = 256 << 20  #: that sums may take where nobody says otherwise
_ROW = 88  # bytes of a voxel's key, count and sums, colours among them
_SAMPLES = 64  # of the keys of each run, for a range


@dataclass(frozen=True, kw_only=True, slots=True)
class FusedCloud:
    """One point for each voxel that was hit, the mean of what lies in it."""

    size: float  #: metres
    keys: NDArray[np.int64]  #: (M,) packed cell indices, ascending
    counts: NDArray[np.int32]  #: (M,) points that were fused
    points: Points  #: (M, 3) float32, metres, in the order of the keys
    views: Normals  #: (M, 3) float32, mean direction to the sensors that saw the voxel; 0 where no origin was given
    colors: Colors | None  #: (M, 3) uint8; None unless all scans have them

    @classmethod
    def of(cls, voxels: Voxels) -> Self:
        """Return the means of sums."""
        return cls(
            size=voxels.size,
            keys=voxels.keys,
            counts=voxels.counts.astype(np.int32),
            points=voxels.points,
            views=voxels.views.astype(np.float32),
            colors=voxels.colors,
        )

    @classmethod
    def empty(cls, count: int, *, size: float, colored: bool) -> Self:
        """Return room for so many voxels."""
        return cls(
            size=size,
            keys=np.empty(count, np.int64),
            counts=np.empty(count, np.int32),
            points=np.empty((count, 3), np.float32),
            views=np.empty((count, 3), np.float32),
            colors=np.empty((count, 3), np.uint8) if colored else None,
        )

    def fill(self, at: slice, piece: FusedCloud) -> None:
        """Put the voxels of a piece into these rows."""
        self.keys[at], self.counts[at] = piece.keys, piece.counts
        self.points[at], self.views[at] = piece.points, piece.views
        if self.colors is not None and piece.colors is not None:
            self.colors[at] = piece.colors


def fused_cloud(parts: Iterable[Voxels], *, memory_bytes: int = MEMORY_BYTES) -> FusedCloud | None:
    """Fuse the sums of all parts; None where there is none.

    Takes about `memory_bytes` beside the answer and a part, and otherwise 64 bytes a voxel of each run (88 with colours)
    in a temporary folder. Where all fits, the answer is bit for bit that of `worker.cloud.voxels.fused`; otherwise sums
    are added in another order, which may change the last bit of a mean. Raises OSError where the disk is full.
    """
    most = max(memory_bytes // (2 * _ROW), 1)
    with TemporaryDirectory(prefix="fusing-") as folder:
        runs: list[_Run] = []
        for voxels in merged_runs(parts, most=most):
            if not runs and len(voxels.keys) <= most // 2:  # no run but the last is so short
                return FusedCloud.of(voxels)
            runs.append(_Run.written(Path(folder) / f"run-{len(runs)}", voxels))
            del voxels  # before the next one grows
        return _added_up(runs, max(memory_bytes // (4 * _ROW), 1)) if runs else None


@dataclass(frozen=True, kw_only=True, slots=True)
class _Run:
    """Sums of voxels in a file, one column behind the other."""

    path: Path
    size: float  #: metres
    rows: int
    width: int  #: columns of the sums

    @classmethod
    def written(cls, path: Path, voxels: Voxels) -> Self:
        """Write what was merged."""
        with path.open("wb") as file:
            for column in (voxels.keys, voxels.counts, voxels.sums):
                column.tofile(file)
        return cls(path=path, size=voxels.size, rows=len(voxels.keys), width=voxels.sums.shape[1])

    def mapped_keys(self) -> NDArray[np.int64]:
        """Return (rows,) the keys, of which only those that are looked at are read."""
        return np.memmap(self.path, np.int64, "r", shape=(self.rows,))

    def keys(self, first: int, last: int) -> NDArray[np.int64]:
        """Read the keys of these rows."""
        return np.fromfile(self.path, np.int64, last - first, offset=8 * first)

    def voxels(self, first: int, last: int) -> Voxels:
        """Read these rows."""
        count, behind = last - first, 16 * self.rows + 8 * self.width * first
        sums: Floats = np.fromfile(self.path, np.float64, count * self.width, offset=behind)
        return Voxels(
            size=self.size,
            keys=self.keys(first, last),
            counts=np.fromfile(self.path, np.int64, count, offset=8 * (self.rows + first)),
            sums=sums.reshape(count, self.width),
        )


def _added_up(runs: Sequence[_Run], most: int) -> FusedCloud:
    """Add the runs up, about `most` of their rows at a time."""
    ranges = list(_ranges(runs, most))
    counts = [
        len(np.unique(np.concatenate([run.keys(*at) for run, at in zip(runs, rows, strict=True)])))
        for rows in ranges
    ]
    colored = min(run.width for run in runs) > 6
    cloud = FusedCloud.empty(sum(counts), size=runs[0].size, colored=colored)
    ends = np.cumsum([0, *counts]).tolist()
    for rows, (first, last) in zip(ranges, pairwise(ends), strict=True):
        sums = Voxels.added([run.voxels(*at) for run, at in zip(runs, rows, strict=True)])
        cloud.fill(slice(first, last), FusedCloud.of(sums))
    return cloud


def _ranges(runs: Sequence[_Run], most: int) -> Iterator[tuple[tuple[int, int], ...]]:
    """Yield ranges of keys, ascending, as the first row of each run and that behind its last."""
    step = max(most // _SAMPLES, 1)
    keys = [run.mapped_keys() for run in runs]
    samples = np.sort(np.concatenate([of_run[::step] for of_run in keys]))
    cuts = np.unique(samples[max(most // step, 1) :: max(most // step, 1)])
    places = [[0, *np.searchsorted(of_run, cuts).tolist(), len(of_run)] for of_run in keys]
    yield from zip(*(tuple(pairwise(of_run)) for of_run in places), strict=True)
