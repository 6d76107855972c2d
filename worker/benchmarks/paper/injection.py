"""Changes made to a few scans of a map at a few tiles (paper, Sections 3.5.1 and 4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from worker.benchmarks.paper.experiment import Experiment
from worker.benchmarks.paper.site import Site, flat_cells, tiles_of
from worker.cloud.types import Bools, Points
from worker.training.anomalies import OPERATIONS, Change

MARGIN = 1e-4  #: metres that a change keeps from the tile's border, which belongs to the next tile
INJECTION_SEED = 42  #: the paper's


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Trace:
    """What was changed in one tile, in the map frame, metres."""

    tile: int  #: its place in the site's tiles
    appeared: Points  #: (a, 3)
    vanished: Points  #: (v, 3)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Injection:
    """A walk with changes in it."""

    scans: dict[int, Points]  #: the modified ones, (n, 3) float32, map frame
    truth: Bools  #: (T,) tiles of the map that were modified
    traces: tuple[Trace, ...]


def inject(site: Site, experiment: Experiment, number: int, *, everywhere: bool = False) -> Injection:
    """Modify `experiment.scans` scans at `experiment.tiles_per_scan` tiles each; the same number, the same changes.

    A scan is modified at tiles in which it has as many voxels as a tile of the map needs, drawn for each scan
    by itself, so that two may fall on the same tile. As the paper has it, only that scan changes, and the others
    still show what was there; with `everywhere` all scans do, as in a place that really changed. Raises
    ValueError where too few scans have so many tiles.
    """
    rng = np.random.default_rng((INJECTION_SEED, site.seed, number))
    truth = np.zeros(len(site.tiles.points), bool)
    if experiment.operation is None:
        return Injection(scans={}, truth=truth, traces=())
    able = [scan for scan, tiles in enumerate(site.dense) if len(tiles) >= experiment.tiles_per_scan]
    if len(able) < experiment.scans:
        raise ValueError(
            f"{experiment.name}: {experiment.scans} scans with {experiment.tiles_per_scan} dense tiles are needed, {len(able)} have them"
        )
    points: dict[int, Points] = {}
    traces = []
    for scan in rng.choice(able, experiment.scans, replace=False).tolist():
        for tile in rng.choice(site.dense[scan], experiment.tiles_per_scan, replace=False).tolist():
            touched = range(len(site.scans)) if everywhere else (scan,)
            traces.append(_change(site, points, list(touched), tile, experiment, rng))
            truth[tile] = True
    return Injection(scans=points, truth=truth, traces=tuple(traces))


def _change(
    site: Site,
    points: dict[int, Points],
    scans: list[int],
    tile: int,
    experiment: Experiment,
    rng: np.random.Generator,
) -> Trace:
    """Change the tile in the given scans as if they were one cloud; `points` takes what becomes of them."""
    grid, index = site.tiles.grid, site.tiles.indices[tile].astype(np.int64)
    cell = flat_cells(index[None], grid)[0]
    centre = grid.centers(index[None])[0]
    before = {scan: points[scan] if scan in points else site.placed(scan) for scan in scans}
    within = {scan: tiles_of(cloud, grid) == cell for scan, cloud in before.items()}
    within = {scan: mask for scan, mask in within.items() if mask.any()}
    cloud = np.concatenate([before[scan][mask] for scan, mask in within.items()])
    change = Change(magnitude=experiment.magnitude, density=experiment.density)
    half = (grid.size / 2 - MARGIN).astype(np.float32)
    operation = OPERATIONS[str(experiment.operation)]
    after = operation((cloud - centre).astype(np.float32), change, half, rng)
    first, *others = within
    for scan in others:
        points[scan] = before[scan][~within[scan]]
    # The scans are fused by averaging in each voxel, so it does not matter which of them a point comes from.
    put = (after.points + centre).astype(np.float32)
    points[first] = np.concatenate([before[first][~within[first]], put])
    return Trace(
        tile=tile,
        appeared=(after.appeared + centre).astype(np.float32),
        vanished=(after.vanished + centre).astype(np.float32),
    )
