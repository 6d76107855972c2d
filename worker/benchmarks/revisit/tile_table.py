"""The tiles of several visits in one table, and what of it a figure is taken over."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.revisit.plan import VisitPlan
from worker.benchmarks.revisit.record import Revisit
from worker.cloud.types import Bools, Floats
from worker.simulation.truth import KINDS

#: Edges of bins, in metres. Poses are off by millimetres where all goes well, by centimetres where it does not.
EDGES = (0.0, 0.0025, 0.005, 0.01, 0.02, np.inf)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TileTable:
    """N tiles, visit after visit."""

    changed: Bools  #: (N,) something changed, seen or not
    counted: Bools  #: (N,) a method can be right or wrong about it
    observed: Bools  #: (N,) the survey saw it densely enough
    slight: Bools  #: (N,) something changed, but too little for a changed tile
    kind: NDArray[np.int64]  #: (N,) index into KINDS, or NOTHING
    misfit: Floats  #: (N,) metres
    sigma: Floats  #: (N,) metres
    visit: NDArray[np.int64]  #: (N,) number of the visit
    case: NDArray[np.str_]  #: (N,)
    building: NDArray[np.str_]  #: (N,)

    def groups(self) -> dict[str, dict[str, Bools]]:
        """Tiles (N,) of each group, by what they are grouped by.

        Groups by kind of change hold changed tiles only; all others hold unchanged ones too.
        """
        return {
            "kind": {kind: self.kind == number for number, kind in enumerate(KINDS)},
            "case": {case: self.case == case for case in _in_order(self.case)},
            "building": {kind: self.building == kind for kind in _in_order(self.building)},
            "misfit": binned(self.misfit),
            "sigma": binned(self.sigma),
        }


def tile_table(plans: Sequence[VisitPlan], visits: Sequence[Revisit]) -> TileTable:
    """The visits' tiles one after the other."""
    sizes = [len(visit.cells) for visit in visits]
    return TileTable(
        changed=np.concatenate([visit.exists for visit in visits]),
        counted=np.concatenate([visit.counted for visit in visits]),
        observed=np.concatenate([visit.pairs.observed for visit in visits]),
        slight=np.concatenate([(visit.cells.sum(axis=1) > 0) & ~visit.exists for visit in visits]),
        kind=np.concatenate([visit.kinds for visit in visits]),
        misfit=np.concatenate([visit.misfit for visit in visits]),
        sigma=np.concatenate([visit.sigma for visit in visits]),
        visit=np.repeat(np.arange(len(visits)), sizes),
        case=np.repeat([plan.case for plan in plans], sizes),
        building=np.repeat([plan.site.kind for plan in plans], sizes),
    )


def binned(metres: Floats) -> dict[str, Bools]:
    """Which values (N,) lie in each bin, lower edge included; NaN lies in none."""
    bins = {}
    for low, high in itertools.pairwise(EDGES):
        words = f"over {100 * low:g} cm" if np.isinf(high) else f"{100 * low:g} to {100 * high:g} cm"
        bins[words] = (metres >= low) & (metres < high)
    return bins


def _in_order(values: NDArray[np.str_]) -> list[str]:
    """Each once, the first first."""
    return list(dict.fromkeys(values.tolist()))
