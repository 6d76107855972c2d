"""Belief: the odds that a pose is right, by what both visits say of each other's points.

A logistic line over shares that speak against a pose. It was fitted on simulated rooms, offices and corridors with up
to 40 % of the furniture changed, against other places of the same kind, the very same rooms furnished anew, and wrong
poses of right scans; `spicd-worker evaluate placement --fit` makes it anew, docs/placement.md has its error curve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from worker.cloud.types import Floats
from worker.pipeline.placement.contradictions import BUILDING, THINGS, Contradictions

FEWEST = 200.0  #: points of one visit that the other has to judge; of fewer nothing is said
#: Points put beside each share, so that a few of them prove little.
_BESIDE_BUILDING, _BESIDE_THINGS = 200.0, 100.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Line:
    """Log odds: `bias` plus the weighted roots of the shares."""

    bias: float
    weights: tuple[float, ...]  #: of `shares`, in their order

    def log_odds(self, shares: Floats) -> float:
        """Return them for shares (7,)."""
        return float(self.bias + np.sqrt(shares) @ np.array(self.weights))


LINE = Line(bias=15.64, weights=(-6.41, -25.70, -6.25, -3.69, -4.45, 0.0, -8.83))


def shares(told: Contradictions) -> Floats:
    """Return (7,) what speaks against a pose, each 0..1.

    Things of which most is denied, of all; points of the building looked through, in the worse and in the better
    direction; points of things looked through, in both directions and in the worse; the scan's points of the building
    off the map's surfaces; points of things off surfaces.
    """
    through = _share(told.through[:, BUILDING], told.judged[:, BUILDING], _BESIDE_BUILDING)
    things = _share(told.through[:, THINGS], told.judged[:, THINGS], _BESIDE_THINGS / 2)
    agree, denied = told.things.sum(axis=0)
    return np.array(
        [
            (denied + 0.5) / (agree + denied + 1.0),
            through.max(),
            through.min(),
            _share(told.through[:, THINGS].sum(), told.judged[:, THINGS].sum(), _BESIDE_THINGS),
            things.max(),
            _share(told.off[0, BUILDING], told.near[0, BUILDING], _BESIDE_BUILDING),
            _share(told.off[:, THINGS].sum(), told.near[:, THINGS].sum(), _BESIDE_THINGS),
        ]
    )


def log_odds(told: Contradictions, line: Line = LINE) -> float | None:
    """Return the log odds of a pose; None where too little was seen to say anything.

    Where the rays of one visit alone are known, or looked where the other has points, they speak for both.
    """
    enough = told.judged.sum(axis=1) >= FEWEST
    if not enough.any():
        return None
    speaks = np.flatnonzero(enough)[[0, -1]]  # each way, or the one that has to do twice
    return line.log_odds(shares(replace(told, judged=told.judged[speaks], through=told.through[speaks])))


def confidence(odds: float) -> float:
    """Return the probability, 0..1, of log odds."""
    return float(1 / (1 + np.exp(-odds)))


def odds_of(probability: float) -> float:
    """Return the log odds of a probability between 0 and 1."""
    return float(np.log(probability / (1 - probability)))


def _share(part: Floats, whole: Floats, beside: float) -> Floats:
    shares: Floats = part / (whole + beside)
    return shares
