"""Seen: what one visit saw, voxel by voxel, with the range images behind it; kept with a map, made of each survey.

It is what the evidence for a change is computed of (`worker.detectors.voxels`): a place was hit by one visit, and the
other saw through it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from worker.cloud.fusing import FusedCloud
from worker.cloud.sight import Sights, Verdicts
from worker.cloud.types import Bools, Floats, Points
from worker.cloud.voxels import Voxels, fused


class PlacedScan(Protocol):
    """A scan in the map frame."""

    @property
    def points(self) -> Points:
        """(N, 3) float32, metres, map frame."""

    @property
    def sensor_origin(self) -> Floats | None:
        """(3,) metres, map frame; None where the points cannot all have been seen from one place."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Seen:
    """The occupied voxels of a visit, and how far its scans saw."""

    voxel_size: float  #: metres
    keys: NDArray[np.int64]  #: (V,) of the map frame, ascending, as `Voxels.keys_of` packs them
    points: Points  #: (V, 3) float32, metres, map frame: the mean of each voxel's returns
    hits: NDArray[np.int32]  #: (V,) returns from within the voxel
    sights: Sights | None  #: None: no scan of the visit has a place that its points were seen from

    @classmethod
    def of(cls, scans: Iterable[PlacedScan], *, voxel_size: float) -> Self:
        """Sort the returns into voxels and keep each scan's range image; one scan is held at a time.

        A scan without the sensor's place gives hits alone. Raises MapFailed for points too far from the origin.
        """
        sights: list[Sights | None] = []

        def voxels() -> Iterator[Voxels]:
            for scan in scans:
                yield Voxels.of(scan.points, size=voxel_size)
                if scan.sensor_origin is not None:
                    sights.append(Sights.of([(scan.points, scan.sensor_origin)]))

        nothing = Voxels.of(np.empty((0, 3), np.float32), size=voxel_size)
        return cls.of_voxels(fused(voxels()) or nothing, sights)

    @classmethod
    def of_voxels(cls, voxels: Voxels | FusedCloud, sights: Iterable[Sights | None]) -> Self:
        """Put the fused returns of a visit and its scans' range images together."""
        return cls(
            voxel_size=voxels.size,
            keys=voxels.keys,
            points=voxels.points,
            hits=voxels.counts.astype(np.int32, copy=False),
            sights=Sights.joined(sights),
        )

    def merged(self, other: Self) -> Self:
        """Return what both visits saw together."""
        return self.of_voxels(self._sums().merged(other._sums()), [self.sights, other.sights])

    def without(self, gone: Bools) -> Self:
        """Return the same less some voxels: gone (V,). The range images stay."""
        return type(self)(
            voxel_size=self.voxel_size,
            keys=self.keys[~gone],
            points=self.points[~gone],
            hits=self.hits[~gone],
            sights=self.sights,
        )

    def verdicts(self, points: Points) -> Verdicts:
        """Say what the visit's scans tell of places (N, 3), metres, map frame; nothing where it has no sights."""
        return Verdicts.none(len(points)) if self.sights is None else self.sights.verdicts(points)

    def _sums(self) -> Voxels:
        counts = self.hits.astype(np.int64)
        sums = np.zeros((len(counts), 6))
        sums[:, :3] = self.points * counts[:, None]
        return Voxels(size=self.voxel_size, keys=self.keys, counts=counts, sums=sums)
