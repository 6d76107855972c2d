"""The second visit: the building is edited, walked anew, and the pipeline lays what was seen over the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from worker.benchmarks.revisit.misfit import residual_misalignments, stated_sigmas
from worker.benchmarks.revisit.plan import RevisitSettings, VisitPlan, edit_kinds
from worker.benchmarks.revisit.record import Revisit
from worker.benchmarks.revisit.site import (
    Site,
    errors_of,
    placed_scans,
    prefixed,
    written,
)
from worker.cloud.tiling import TileGrid, TilePairs, Tiles, pair_tiles
from worker.cloud.types import Bools, Indices, Matrix4
from worker.pipeline.flow import NoScanAccepted, locate_survey
from worker.pipeline.registration.results import ScanFile, ScanResult
from worker.progress import Progress, no_progress
from worker.simulation.scenes import Scene, random_edits
from worker.simulation.truth import TileTruth, changed_tiles
from worker.simulation.visits import drifted_within, stops, visit

DRAWS, ANOTHER = (
    20,
    100_000_000,
)  #: of edits, and between the seeds of two draws: no seed of a visit is that high


def walk_again(
    plan: VisitPlan, site: Site, settings: RevisitSettings, folder: Path, progress: Progress = no_progress
) -> Revisit:
    """Simulate the second visit into the folder and pair its tiles with the map's.

    Its priors are off by as much as the first's, in the frame of the map. Where no scan finds its place, every tile
    is unobserved. Raises ScanError where a file cannot be read, ValueError where no edits leave a way.
    """
    progress(f"{plan.name}: simulating the second visit", 0.0)
    after, poses = edited(site.before, plan, settings)
    seen = visit(
        after,
        poses,
        seed=plan.seed,
        prior_error=settings.drift,
        drift=drifted_within,
        duration_s=settings.standing_s,
    )
    files = written(seen, folder, plan.case, site.map_from_world)
    pairs, outcomes = _located(files, site, settings, prefixed(progress, f"{plan.name}: "))
    scans = placed_scans(outcomes, seen, site.map_from_world)
    tiles = site.built.tiles
    sensors = [scan.true for scan in site.scans], [scan.true for scan in scans]
    exists, visible = true_changes(site.before, after, tiles.grid, site.map_from_world, *sensors)
    at = tuple((tiles.indices - tiles.grid.lowest).T)
    return Revisit(
        name=plan.name,
        pairs=pairs,
        cells=exists.cells[at],
        in_sight=visible.cells[at],
        outside=int((exists.changed & ~kept_tiles(tiles.grid, tiles.indices)).sum()),
        misfit=residual_misalignments(site.scans, scans, tiles.grid, tiles.indices),
        sigma=stated_sigmas(scans, tiles.grid, tiles.indices),
        first=site.errors,
        second=errors_of(scans, len(seen)),
    )


def edited(before: Scene, plan: VisitPlan, settings: RevisitSettings) -> tuple[Scene, tuple[Matrix4, ...]]:
    """As the second visit finds it, and where it stops; edits that leave a robot no way are drawn again.

    Raises ValueError where no draw leaves one.
    """
    count, blocked = second_stops(plan, settings), ValueError(plan.name)
    for draw in range(DRAWS):
        after = before
        if plan.case != "unchanged":
            kinds = edit_kinds(settings.edits[plan.site.kind])
            after = random_edits(before, seed=plan.seed + draw * ANOTHER, kinds=kinds)[0]
        try:
            return after, stops(after, count, seed=plan.seed)
        except ValueError as error:
            blocked = error
    raise blocked


def second_stops(plan: VisitPlan, settings: RevisitSettings) -> int:
    """How many."""
    stops = settings.stops[plan.site.kind]
    return max(1, round(stops * settings.sparse_share)) if plan.case == "sparse" else stops


def true_changes(
    before: Scene,
    after: Scene,
    grid: TileGrid,
    map_from_world: Matrix4,
    first: list[Matrix4],
    second: list[Matrix4],
) -> tuple[TileTruth, TileTruth]:
    """What exists in one visit only, and of that what a sensor could see; the grid and the sensors in the map frame."""
    old, new = (scene.placed(map_from_world) for scene in (before, after))
    exists = changed_tiles(old, new, grid)
    if not exists.cells.any():
        return exists, exists
    visible = changed_tiles(old, new, grid, sensors_before=first, sensors_after=second)
    return exists, visible


def kept_tiles(grid: TileGrid, indices: Indices) -> Bools:
    """(I, J, K) which tiles of the grid the map has."""
    there = np.zeros(grid.shape, dtype=np.bool_)
    there[tuple((indices - grid.lowest).T)] = True
    return there


def _located(
    files: tuple[ScanFile, ...], site: Site, settings: RevisitSettings, progress: Progress
) -> tuple[TilePairs, tuple[ScanResult, ...]]:
    built = site.built
    try:
        located = locate_survey(files, built.reference, settings=settings.pipeline, progress=progress)
    except NoScanAccepted as nobody:
        return _unobserved(built.tiles, settings), nobody.outcomes
    return located.comparison.tile_pairs, located.outcomes


def _unobserved(tiles: Tiles, settings: RevisitSettings) -> TilePairs:
    return pair_tiles(tiles, np.empty((0, 3), np.float32), settings=settings.pipeline.tiling)
