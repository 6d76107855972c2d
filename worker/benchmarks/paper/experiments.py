"""The experiments: changes made to a few scans of the map at a few tiles, up to the tile pairs that methods are given.

Which experiments there are, and what the paper found with them, stands in `published.json` beside this file (paper,
Sections 3.5.1 and 4.2).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from worker.benchmarks.paper.site import Site
from worker.cloud.formats.scan import Scan
from worker.cloud.poses import inverse, transformed
from worker.cloud.seen import Seen
from worker.cloud.tiling import TilePairs, pair_tiles
from worker.cloud.types import Bools, Floats, Points
from worker.cloud.voxels import Voxels, merged_in_order
from worker.detectors.comparison import Comparison, Side, side_of
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.scan_to_map import register
from worker.progress import Progress
from worker.simulation.scenes import ChangeKind
from worker.training.anomalies import OPERATIONS, ChangeSize

MARGIN = 1e-4  #: metres that a change keeps from the tile's border, which belongs to the next tile
INJECTION_SEED = 42  #: the paper's


@dataclass(frozen=True, kw_only=True, slots=True)
class Experiment:
    """One row of Table 4."""

    name: str
    series: str  #: magnitude, density, type, challenge or baseline
    operation: ChangeKind | None  #: None: nothing is changed
    magnitude: float  #: metres of displacement
    density: float  #: share of a tile's points that are touched
    scans: int  #: that are modified
    tiles_per_scan: int  #: that are modified in each of them


@cache
def published() -> dict[str, Any]:
    """Read what the paper prints: its experiments and its results, with their source."""
    text = files("worker.benchmarks.paper").joinpath("published.json").read_text("utf-8")
    tables: dict[str, Any] = json.loads(text)
    return tables


def experiments(only: Sequence[str] | None = None) -> tuple[Experiment, ...]:
    """Return the fourteen of Table 4, in its order, or those named. Raises ValueError for a name that is not there."""
    every = tuple(Experiment(**row) for row in published()["experiments"])
    names = [experiment.name for experiment in every]
    unknown = sorted(set(only or ()) - set(names))
    if unknown:
        raise ValueError(f"no experiment {', '.join(unknown)}; there are {', '.join(names)}")
    return tuple(experiment for experiment in every if only is None or experiment.name in only)


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
            f"{experiment.name}: {experiment.scans} scans with {experiment.tiles_per_scan} dense tiles are needed, "
            f"{len(able)} have them"
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
    grid, index = site.tiles.grid, site.tiles.indices[[tile]]
    cell, centre = grid.cells(index)[0], grid.centers(index)[0]
    before = {scan: points[scan] if scan in points else site.placed(scan) for scan in scans}
    within = {scan: grid.locate(cloud) == cell for scan, cloud in before.items()}
    within = {scan: mask for scan, mask in within.items() if mask.any()}
    cloud = np.concatenate([before[scan][mask] for scan, mask in within.items()])
    change = ChangeSize(magnitude=experiment.magnitude, density=experiment.density)
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


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Trial:
    """An experiment carried out: what methods have to tell apart, and the truth."""

    experiment: Experiment
    pairs: TilePairs
    truth: Bools  #: (T,) tiles that were modified
    traces: tuple[Trace, ...]  #: what was changed in them
    current: Points  #: (M, 3) float32, the current map, map frame
    left_out: int  #: modified scans that could not be registered again
    seen: tuple[Seen, Seen] | None = (
        None  #: what the scans of the map and of the current map saw; if asked for
    )

    @property
    def comparison(self) -> Comparison:
        """The map and the current map side by side."""
        first, second = self.seen or (None, None)
        reference = replace(side_of(self.pairs.reference), seen=first)
        return Comparison(
            reference=reference, current=Side(points=self.current, seen=second), tile_pairs=self.pairs
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacedPoints:
    """A scan of a trial where it was registered."""

    points: Points  #: (n, 3) float32, metres, map frame
    sensor_origin: Floats  #: (3,) metres, map frame


def trials(
    site: Site,
    experiments: Sequence[Experiment],
    progress: Progress,
    *,
    everywhere: bool = False,
    seen: bool = False,
) -> Iterator[Trial]:
    """Carry out one experiment after the other; each holds some ten megabytes.

    With `seen` each comes with what the scans saw, for detectors by voxels: one to two seconds more.
    """
    before = seen_by(site, {}) if seen else None
    for number, experiment in enumerate(experiments):
        progress(f"{site.name}: {experiment.name}", number / len(experiments))
        yield _carried_out(site, experiment, inject(site, experiment, number, everywhere=everywhere), before)


def seen_by(site: Site, changed: Mapping[int, PlacedPoints | None]) -> Seen:
    """Return what all scans of the site saw, those that changed in place of what they were; None is left out."""
    every = (changed[scan] if scan in changed else _placed(site, scan) for scan in range(len(site.scans)))
    present = (scan for scan in every if scan is not None)
    return Seen.of(present, voxel_size=site.settings.registration.voxel_size)


def _placed(site: Site, scan: int) -> PlacedPoints:
    return PlacedPoints(points=site.placed(scan), sensor_origin=site.poses[scan][:3, 3])


def _carried_out(site: Site, experiment: Experiment, injection: Injection, before: Seen | None) -> Trial:
    changed = {scan: _registered(site, scan, points) for scan, points in injection.scans.items()}
    size = site.settings.registration.voxel_size
    parts = {
        scan: Voxels.of(placed.points, size=size) for scan, placed in changed.items() if placed is not None
    }
    every = [parts.get(scan, voxels) for scan, voxels in enumerate(site.voxels)]
    left_out = changed.keys() - parts.keys()
    current = merged_in_order([part for scan, part in enumerate(every) if scan not in left_out]).points
    return Trial(
        experiment=experiment,
        pairs=pair_tiles(site.tiles, current, settings=site.settings.tiling),
        truth=injection.truth,
        traces=injection.traces,
        current=current,
        left_out=len(left_out),
        seen=None if before is None else (before, seen_by(site, changed)),
    )


def _registered(site: Site, scan: int, points: Points) -> PlacedPoints | None:
    """Register a modified scan (n, 3), map frame, to the map again, from where it stood; None where it is not accepted.

    Where poses are to be true ones it stays where it is.
    """
    if site.surface is None:
        return PlacedPoints(points=points, sensor_origin=site.poses[scan][:3, 3])
    own = transformed(points, inverse(site.poses[scan])).astype(np.float32)
    read = Scan(name=f"scan {scan}", points=own, colors=None, sensor_pose=np.eye(4), n_dropped=0)
    settings = site.settings.registration
    try:
        hypothesis = register(
            prepare(read, settings), site.surface, prior=site.poses[scan], settings=settings
        )
    except ScanRejected:
        return None
    pose = hypothesis.target_from_source
    return PlacedPoints(points=transformed(own, pose).astype(np.float32), sensor_origin=pose[:3, 3])
