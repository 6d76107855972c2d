"""An experiment: which changes are made to how many scans (paper, Section 4.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["add", "remove", "move"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Experiment:
    """One row of Table 4."""

    name: str
    series: str  #: magnitude, density, type, challenge or baseline
    operation: Kind | None  #: None: nothing is changed
    magnitude: float  #: metres of displacement
    density: float  #: share of a tile's points that are touched
    scans: int  #: that are modified
    tiles_per_scan: int  #: that are modified in each of them
