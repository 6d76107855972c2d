"""The tiles of all visits in one table, and the truth about each: what every method is counted by."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.revisit.plan import VisitPlan
from worker.benchmarks.revisit.visits import Revisit, RevisitSite
from worker.cloud.tiling import TileGrid, grown
from worker.cloud.types import Bools, Floats, Indices
from worker.cloud.voxel_keys import Keys, centers, dilated
from worker.metrics import Confusion, Scores, confusion
from worker.simulation.hits import HitTruth
from worker.simulation.truth import CELL, KINDS, MIN_CELLS

NOTHING = -1  #: in place of an index into KINDS
#: Edges of bins, in metres. Poses are off by millimetres where all goes well, by centimetres where it does not.
MISFIT_EDGES = (0.0, 0.0025, 0.005, 0.01, 0.02, 0.04, np.inf)
COVERAGE_EDGES = (0.0, 0.25, 0.5, 1.0, np.inf)  #: points of the survey in a tile a point of the map


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class DecidableTiles:
    """The truth about T tiles of one visit."""

    cells: NDArray[np.int32]  #: (T, 3) decidable changed voxels, by kind of change as in KINDS
    touched: Bools  #: (T,) within a voxel of a changed surface, decidable or not

    @property
    def changed(self) -> Bools:
        """(T,) at least 40 decidable changed voxels, 0.1 square metres."""
        enough: Bools = self.cells.sum(axis=1) >= MIN_CELLS
        return enough

    @property
    def counted(self) -> Bools:
        """(T,) truly changed, or not changed at all: a method can be right or wrong about it."""
        return self.changed | ~self.touched


def tile_truth(truth: HitTruth, tiles: Indices, grid: TileGrid) -> DecidableTiles:
    """Count the changed voxels in each of the tiles (T, 3)."""
    cells = np.zeros((len(tiles), len(KINDS)), np.int32)
    kinds = truth.kind_of()
    for kind in range(len(KINDS)):
        keys = np.unique(truth.keys[truth.decidable & (kinds == kind)])
        cells[:, kind] = _per_tile(keys, tiles, grid)
    changed = np.union1d(truth.surface, truth.keys)
    return DecidableTiles(cells=cells, touched=_per_tile(dilated(changed, 1), tiles, grid) > 0)


def _per_tile(keys: Keys, tiles: Indices, grid: TileGrid) -> NDArray[np.int64]:
    rows = grid.locate_among(centers(keys, CELL), tiles)
    counts: NDArray[np.int64] = np.bincount(rows + 1, minlength=len(tiles) + 1)[1:]
    return counts


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TileTable:
    """N tiles, visit after visit: all that either visit, or a true change, has a voxel in."""

    cells: NDArray[np.int32]  #: (N, 3) decidable changed voxels, by kind
    changed: Bools  #: (N,) truly, and either visit could decide it
    counted: Bools  #: (N,) changed, or without any change
    dense: Bools  #: (N,) the map has points enough there to compare patches
    coverage: Floats  #: (N,) points of the survey for each of the map; inf where the map has none
    misalignment: Floats  #: (N,) metres, residual; NaN where either visit has no point
    visit: NDArray[np.int64]  #: (N,) number of the visit
    case: NDArray[np.str_]  #: (N,)
    building: NDArray[np.str_]  #: (N,)
    quiet: Bools  #: (N,) the visit is one before which nothing was edited

    @property
    def kind(self) -> NDArray[np.int64]:
        """(N,) index into KINDS of what changed most in the tile, or NOTHING where it is not a changed one."""
        return np.where(self.changed, self.cells.argmax(axis=1), NOTHING)

    def count(self, scores: Scores, threshold: float, tiles: Bools | None = None) -> Confusion:
        """Count those of the tiles (N,), or of all, that a method flagged rightly and wrongly at a threshold.

        A tile without a score (NaN) is not flagged, and if it changed it is a miss.
        """
        chosen = slice(None) if tiles is None else tiles
        return confusion(scores[chosen], self.changed[chosen], threshold, self.counted[chosen])

    def groups(self) -> dict[str, dict[str, Bools]]:
        """Return the tiles (N,) of each group, by what they are grouped by.

        Groups by kind of change hold changed tiles only; all others hold unchanged ones too.
        """
        return {
            "kind": {kind: self.kind == number for number, kind in enumerate(KINDS)},
            "case": _each(self.case),
            "building": _each(self.building),
            "tile": {"dense in the map": self.dense, "thin in the map": ~self.dense},
            "coverage": binned(self.coverage, COVERAGE_EDGES, "{:g}"),
            "misfit": binned(self.misalignment, MISFIT_EDGES, "{:g} cm", scale=100),
        }


def tile_table(
    plans: Sequence[VisitPlan],
    visits: Sequence[Revisit],
    sites: Mapping[str, RevisitSite],
    *,
    min_points: int,
) -> TileTable:
    """Put the visits' tiles one after the other. `sites` are the maps by name."""
    parts = []
    for plan, revisit in zip(plans, visits, strict=True):
        site = sites[plan.site.name]
        middles = site.reference.grid.centers(revisit.tiles).astype(np.float32)
        grid = grown(site.reference.grid, np.concatenate([site.reference.points, middles]))
        truth = tile_truth(revisit.truth, revisit.tiles, grid)
        mapped, now = (
            np.bincount(grid.locate_among(points, revisit.tiles) + 1, minlength=len(revisit.tiles) + 1)[1:]
            for points in (site.reference.points, revisit.points)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            coverage = np.where(mapped > 0, now / np.maximum(mapped, 1), np.inf)
        parts.append((truth.cells, truth.changed, truth.counted, mapped >= min_points, coverage))
    cells, changed, counted, dense, coverage = (np.concatenate(part) for part in zip(*parts, strict=True))
    sizes = [len(revisit.tiles) for revisit in visits]
    return TileTable(
        cells=cells,
        changed=changed,
        counted=counted,
        dense=dense,
        coverage=coverage,
        misalignment=np.concatenate([revisit.misalignment for revisit in visits]),
        visit=np.repeat(np.arange(len(visits)), sizes),
        case=np.repeat([plan.case for plan in plans], sizes),
        building=np.repeat([plan.site.kind for plan in plans], sizes),
        quiet=np.repeat([plan.quiet for plan in plans], sizes),
    )


def binned(values: Floats, edges: Sequence[float], form: str, *, scale: float = 1) -> dict[str, Bools]:
    """Mark the values (N,) that lie in each bin, lower edge included; NaN lies in none."""
    bins = {}
    for low, high in itertools.pairwise(edges):
        last = form.format(scale * high)
        name = f"over {form.format(scale * low)}" if np.isinf(high) else f"{scale * low:g} to {last}"
        bins[name] = (values >= low) & ((values < high) | np.isinf(high))
    return bins


def _each(names: NDArray[np.str_]) -> dict[str, Bools]:
    return {name: names == name for name in dict.fromkeys(names.tolist())}
