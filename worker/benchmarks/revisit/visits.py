"""The visits: a building is walked and mapped, edited and walked anew, and the pipeline lays that over the map.

Simulating and registering is what takes the time, so every second visit is kept on disk as it is measured: its tile
pairs from the pipeline, and the truth about each of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.revisit.misalignment import residual_misalignments, stated_sigmas
from worker.benchmarks.revisit.plan import RevisitSettings, SitePlan, VisitPlan
from worker.benchmarks.timing import StageClock
from worker.benchmarks.trajectory import PlacedScan, map_frame, placed_scans, scan_files
from worker.cloud import npz
from worker.cloud.tiling import TilePairs, pair_tiles
from worker.cloud.types import Bools, Floats, Matrix4
from worker.pipeline.flow import BuiltMap, NoScanAccepted, build_map, locate_survey
from worker.pipeline.registration.results import ScanFile, ScanResult
from worker.progress import Progress, no_progress
from worker.simulation.scenes import Scene, rigid
from worker.simulation.sensor import SimulatedScan
from worker.simulation.truth import MIN_CELLS, true_changes
from worker.simulation.visits import drifted_within, edited, visit

NOTHING = -1  #: in place of an index into KINDS


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ScanErrors:
    """The scans of one visit against the truth."""

    scans: int  #: taken
    metres: Floats  #: (A,) of those accepted: how far off the sensor's place is
    sigmas: Floats  #: (A,) metres, as stored with the map or survey; NaN where none is stated

    @property
    def accepted(self) -> int:
        return len(self.metres)

    @classmethod
    def of(cls, accepted: Sequence[PlacedScan], taken: int) -> ScanErrors:
        """Measure the accepted scans; `taken` are all."""
        sigmas = [scan.placement.uncertainty for scan in accepted]
        return cls(
            scans=taken,
            metres=np.array([scan.error[0] for scan in accepted]),
            sigmas=np.array([np.nan if sigma is None else sigma.translation for sigma in sigmas]),
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Revisit:
    """One second visit on its map. T tiles, those of the map."""

    name: str
    pairs: TilePairs
    #: (T, 3) cells of 5 cm whose surface exists in one visit only, by kind as in KINDS
    cells: NDArray[np.int32]
    #: (T, 3) of these, those that a sensor of the visit in which they exist could see
    in_sight: NDArray[np.int32]
    outside: int  #: changed tiles that the map does not keep: too few points before
    misalignment: Floats  #: (T,) metres that the poses put the survey off the map
    sigma: Floats  #: (T,) metres of that which the survey's stored sigmas allow for
    first: ScanErrors
    second: ScanErrors

    @property
    def exists(self) -> Bools:
        """(T,) whether something truly changed in the tile, seen or not."""
        enough: Bools = self.cells.sum(axis=1) >= MIN_CELLS
        return enough

    @property
    def changed(self) -> Bools:
        """(T,) whether something changed that could be seen."""
        enough: Bools = self.in_sight.sum(axis=1) >= MIN_CELLS
        return enough

    @property
    def counted(self) -> Bools:
        """(T,) tiles that a method can be right or wrong about.

        They were observed, and a change in them did not happen out of every sensor's sight.
        """
        return self.pairs.observed & (self.changed | ~self.exists)

    @property
    def kinds(self) -> NDArray[np.int64]:
        """(T,) index into KINDS of what changed most in the tile, or NOTHING."""
        return np.where(self.exists, self.cells.argmax(axis=1), NOTHING)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MappedSite:
    """A building with its map, and the truth about the map."""

    plan: SitePlan
    before: Scene
    built: BuiltMap
    map_from_world: Matrix4  #: (4, 4) by the best fit of all poses: a map has the frame of its priors
    scans: tuple[PlacedScan, ...]  #: of the map
    errors: ScanErrors


def make_visits(
    plans: Sequence[VisitPlan], settings: RevisitSettings, folder: Path, progress: Progress = no_progress
) -> tuple[Path, int]:
    """Make the visits that the folder lacks; return where it lies, and how many had to be made.

    Visits made with other settings lie beside them under another name. A map is built anew where a visit to it is
    missing. Raises MapFailed, and OSError for the folder.
    """
    place = folder / settings.fingerprint
    place.mkdir(parents=True, exist_ok=True)
    made = 0
    for site, group in itertools.groupby(plans, key=lambda plan: plan.site):
        missing = [plan for plan in group if not path_of(plan.name, place).exists()]
        if not missing:
            continue
        with TemporaryDirectory(prefix="spicd-revisit-") as scratch:
            mapped = map_site(site, settings, Path(scratch), progress)
            for plan in missing:
                revisit = walk_again(plan, mapped, settings, Path(scratch), progress)
                npz.save(path_of(plan.name, place), revisit)
        made += len(missing)
    return place, made


def load_visits(plans: Iterable[VisitPlan], place: Path) -> tuple[Revisit, ...]:
    """Read the visits from where `make_visits` put them. Raises OSError, and ValueError for other files."""
    return tuple(npz.load(path_of(plan.name, place), Revisit) for plan in plans)


def path_of(name: str, place: Path) -> Path:
    """Return the file of plain arrays that a visit is kept in."""
    return place / f"{name}.npz"


def map_site(
    plan: SitePlan, settings: RevisitSettings, folder: Path, progress: Progress = no_progress
) -> MappedSite:
    """Simulate the first visit into the folder and build the map. Raises MapFailed, NothingToTile.

    The robot's own frame is turned at random against the building: no wall runs along the tiles but by chance.
    """
    progress(f"{plan.name}: simulating the first visit", 0.0)
    scene = plan.scene()
    rng = np.random.default_rng([plan.seed, 5])
    robot_from_world = rigid(*rng.uniform(-3, 3, 2), yaw=float(rng.uniform(0, 360)))
    taken = _walked(scene, settings.stops[plan.kind], 10 * plan.seed, settings, folder, "map")
    files = scan_files(taken, robot_from_world)
    titled = StageClock(progress, prefix=f"{plan.name}: ")
    built = build_map(files, settings=settings.pipeline, progress=titled)
    map_from_world = map_frame(built.outcomes, taken)
    scans = placed_scans(built.outcomes, taken, map_from_world)
    return MappedSite(
        plan=plan,
        before=scene,
        built=built,
        map_from_world=map_from_world,
        scans=scans,
        errors=ScanErrors.of(scans, len(taken)),
    )


def walk_again(
    plan: VisitPlan,
    site: MappedSite,
    settings: RevisitSettings,
    folder: Path,
    progress: Progress = no_progress,
) -> Revisit:
    """Simulate the second visit into the folder and pair its tiles with the map's.

    Its priors are off by as much as the first's, in the frame of the map. Where no scan finds its place, every tile
    is unobserved. Raises ScanError where a file cannot be read, ValueError where no edits leave a way.
    """
    progress(f"{plan.name}: simulating the second visit", 0.0)
    after, poses = edited(site.before, plan.edits(settings), seed=plan.seed, count=plan.stops(settings))
    taken = _walked(after, poses, plan.seed, settings, folder, plan.case)
    titled = StageClock(progress, prefix=f"{plan.name}: ")
    pairs, outcomes = _located(scan_files(taken, site.map_from_world), site, settings, titled)
    scans = placed_scans(outcomes, taken, site.map_from_world)
    grid, indices = site.built.tiles.grid, site.built.tiles.indices
    exists, visible = true_changes(
        site.before,
        after,
        grid,
        map_from_world=site.map_from_world,
        first=[scan.true for scan in site.scans],
        second=[scan.true for scan in scans],
    )
    return Revisit(
        name=plan.name,
        pairs=pairs,
        cells=exists.cells_of(indices),
        in_sight=visible.cells_of(indices),
        outside=int(exists.changed.sum() - exists.of(indices).sum()),
        misalignment=residual_misalignments(site.scans, scans, grid, indices),
        sigma=stated_sigmas(scans, grid, indices),
        first=site.errors,
        second=ScanErrors.of(scans, len(taken)),
    )


def _walked(
    scene: Scene,
    poses: int | tuple[Matrix4, ...],
    seed: int,
    settings: RevisitSettings,
    folder: Path,
    name: str,
) -> tuple[SimulatedScan, ...]:
    """Simulate a visit into the folder, its priors drifted."""
    return visit(
        scene,
        poses,
        seed=seed,
        prior_error=settings.drift,
        drift=drifted_within,
        duration_s=settings.standing_s,
        folder=folder,
        name=f"{name}-{{:02d}}",
    )


def _located(
    files: tuple[ScanFile, ...], site: MappedSite, settings: RevisitSettings, progress: Progress
) -> tuple[TilePairs, tuple[ScanResult, ...]]:
    reference, tiles = site.built.reference, site.built.tiles
    try:
        located = locate_survey(files, reference, settings=settings.pipeline, progress=progress)
    except NoScanAccepted as nobody:
        nothing = np.empty((0, 3), np.float32)
        return pair_tiles(tiles, nothing, settings=settings.pipeline.tiling), nobody.outcomes
    return located.comparison.tile_pairs, located.outcomes
