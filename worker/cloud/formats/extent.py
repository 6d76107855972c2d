"""Extent: where most points of a file lie; what follows of that for its units, and for points far from all others.

One return of a mirror or a broken cable lies kilometres away and would ruin every bounding box, so a few of them are
left out and counted. What is wrong with most points of a file is refused: another unit, or an origin far away.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.fields import FARTHEST
from worker.cloud.types import Bools, Floats
from worker.errors import ScanError, ScanFarAway, ScanUnits

LONGEST_SITE = 500.0  #: metres along one axis; an indoor scan that is longer is not in metres
SHORTEST_ROOM = 3.0  #: metres; what another unit would make of the extent has to be a room
FAR = 250.0  #: metres outside the middle 90% of the points, on an axis; no sensor for rooms sees that far
MOST_FAR = 0.02  #: share of the points that may lie there
ROUND = 100.0  #: metres; what an offset is a multiple of
ON_EARTH = 1e8  #: metres from the origin, that no coordinate of a place exceeds
SAMPLE = 100_000  #: points that the extent is measured on
_ALL, _CORE = (1, 99), (5, 95)  # percentiles: without strays, and with as many as may be dropped

Positions = NDArray[np.floating[Any]]  #: (N, 3) metres, in the file's type


@dataclass(slots=True)
class Extent:
    """The box that points have to lie in to be near the others, and a count of those that do not."""

    low: Floats  #: (3,) metres
    high: Floats  #: (3,) metres
    n_far: int = 0  #: points outside
    farthest: float = 0.0  #: metres from the middle of the box to the farthest of them
    offset: Floats = field(
        default_factory=lambda: np.zeros(3)
    )  #: (3,) metres, to be taken off before float32

    @classmethod
    def of(cls, sample: Positions, *, anywhere: bool = False) -> Self:
        """Measure a sample (K, 3) of the finite points of a file; `anywhere`: they may lie far from the origin.

        Raises ScanUnits where it is longer than any site, ScanError where too many of its points lie far from the
        others, and ScanFarAway where all of them lie far from the origin.
        """
        halves = sample.astype(np.float64) / 2  # the difference of two of which cannot overflow
        low, high = np.percentile(halves, _CORE, axis=0)
        if 2 * float(np.max(high - low)) > LONGEST_SITE:
            _check_units(halves)
        low, high = 2 * low - FAR, 2 * high + FAR
        extent = cls(low=low, high=high)
        near = extent.near(sample)
        share = 1 - float(near.mean())
        if share > MOST_FAR:
            raise ScanError(
                f"{share:.1%} of its points lie over {FAR:g} m from the others, up to {_length(extent.farthest)}; up to "
                f"{MOST_FAR:.0%} are left out; filter them, and write missing returns as NaN"
            )
        _check_units(halves[near])
        return cls(low=low, high=high, offset=extent._offset(anywhere=anywhere))

    def near(self, positions: Positions) -> Bools:
        """Tell (N,) which points (N, 3) lie near the others; counts the rest."""
        within: Bools = (positions >= self.low) & (positions <= self.high)
        near: Bools = np.all(within, axis=1)
        far = positions[~near].astype(np.float64)
        if len(far):
            self.n_far += len(far)
            with np.errstate(over="ignore"):  # of a coordinate such as 1e300: infinitely far
                away = np.linalg.norm(far - (self.low + self.high) / 2, axis=1)
            self.farthest = max(self.farthest, float(away.max()))
        return near

    def _offset(self, *, anywhere: bool) -> Floats:
        """Return what is taken off so that float32 keeps millimetres: nothing near the origin.

        Raises ScanFarAway where the points lie too far away, and must not.
        """
        low, high = self.low + FAR, self.high - FAR
        if float(np.abs(np.stack([low, high])).max()) <= FARTHEST:
            return np.zeros(3)
        middle = (low + high) / 2
        rounded: Floats = np.round(middle / ROUND) * ROUND
        if anywhere and float(np.abs(middle).max()) < ON_EARTH:
            return rounded
        away = float(np.linalg.norm(middle))
        offset = ", ".join(f"{value:.0f}" for value in rounded)
        raise ScanFarAway(
            f"its points lie {_length(away)} from the origin of its frame, around "
            f"({', '.join(f'{value:.1f}' for value in middle)}), over {FARTHEST / 1000:g} km, as coordinates of a country's "
            f"grid do; subtract one offset from all scans of the place, such as ({offset})"
        )


def _check_units(halves: Floats) -> None:
    """Raise ScanUnits when the cloud, whose halves (N, 3) these are, is longer than any building."""
    low, high = np.percentile(halves, _ALL, axis=0)
    extent = 2 * float(np.max(high - low))
    if extent <= LONGEST_SITE:
        return
    span = f"it spans {extent:.6g} along one axis, over {LONGEST_SITE:g} m"
    for unit, factor in (("millimetres", 0.001), ("centimetres", 0.01)):  # the commoner one first
        if SHORTEST_ROOM <= extent * factor <= LONGEST_SITE:
            raise ScanUnits(f"{span}: looks like {unit}; multiply by {factor} to get metres")
    raise ScanUnits(f"{span}: not a scan of a building in metres; check its units")


def _length(metres: float) -> str:
    """Write a distance in the unit that people would use."""
    if metres > 1e7:
        return "over 10,000 km"
    return f"{metres / 1000:.1f} km" if metres >= 1000 else f"{metres:.0f} m"
