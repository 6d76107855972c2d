"""The visits: a building is walked and mapped, edited and walked anew, and the pipeline lays that over the map.

Simulating and registering is what takes the time, so every building's map and every second visit is kept on disk as it
was found: what was seen, where the scans stand, and the truth by the simulator's own hits. Scoring reads these alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worker.benchmarks.revisit.misalignment import residual_misalignments, stated_sigmas
from worker.benchmarks.revisit.plan import RevisitSettings, SitePlan, VisitPlan
from worker.benchmarks.revisit.walks import carrier_of, push_of, walk
from worker.benchmarks.timing import StageClock
from worker.benchmarks.trajectory import PlacedScan, map_frame, placed_scans, scan_files
from worker.cloud import npz
from worker.cloud.seen import Seen
from worker.cloud.tiling import TileGrid, touched_tiles
from worker.cloud.types import Bools, Floats, Indices, Matrix4, Points
from worker.cloud.voxel_keys import centers
from worker.cloud.voxels import fused
from worker.pipeline.alarms import visits_of
from worker.pipeline.flow import NoScanAccepted, accepted_scans, build_map, locate_survey
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.pipeline.registration.results import (
    RegisteredScan,
    RegistrationResult,
    ScanFile,
    ScanResult,
    Uncertainty,
    with_carrier,
)
from worker.progress import Progress, no_progress
from worker.simulation.hits import HitTruth, hit_truth
from worker.simulation.scenes import Scene, rigid
from worker.simulation.sensor import SimulatedScan
from worker.simulation.truth import CELL
from worker.simulation.visits import drifted_within, visit


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VisitPoses:
    """The scans of one visit, A of S accepted: where they stand, and where they truly do."""

    accepted: Bools  #: (S,)
    map_from_scan: Floats  #: (A, 4, 4)
    true: Floats  #: (A, 4, 4) map_from_scan as it would be without error
    origins: Floats  #: (A, 3) metres, map frame, of the sensors; NaN where the points contradict the file's
    sigmas: Floats  #: (A, 2) metres and radians, as stored with the map or survey; NaN where none is stated

    @classmethod
    def of(cls, outcomes: Sequence[ScanResult], scans: Sequence[PlacedScan]) -> VisitPoses:
        """Take what became of each scan, and the accepted ones."""
        origins, sigmas = np.full((len(scans), 3), np.nan), np.full((len(scans), 2), np.nan)
        for row, scan in enumerate(scans):
            if scan.placement.sensor_origin is not None:
                origins[row] = scan.placement.sensor_origin
            if scan.placement.uncertainty is not None:
                sigma = scan.placement.uncertainty
                sigmas[row] = sigma.translation, sigma.rotation
        return cls(
            accepted=np.array([outcome.registration is not None for outcome in outcomes]),
            map_from_scan=np.array([s.placement.map_from_scan for s in scans]).reshape(-1, 4, 4),
            true=np.array([scan.true for scan in scans]).reshape(-1, 4, 4),
            origins=origins,
            sigmas=sigmas,
        )

    @property
    def metres(self) -> Floats:
        """(A,) how far off each sensor's place is."""
        off: Floats = np.linalg.norm(self.map_from_scan[:, :3, 3] - self.true[:, :3, 3], axis=1)
        return off

    def placed(self, scans: Sequence[SimulatedScan]) -> tuple[PlacedScan, ...]:
        """Put the poses to the scans (S,) that they are of."""
        return tuple(
            PlacedScan(points=scans[number].points, placement=self._placement(row), true=self.true[row])
            for row, number in enumerate(np.flatnonzero(self.accepted).tolist())
        )

    def _placement(self, row: int) -> RegistrationResult:
        metres, radians = self.sigmas[row].tolist()
        stated = not np.isnan(metres)
        return RegistrationResult(
            map_from_scan=self.map_from_scan[row],
            sensor_origin=None if np.isnan(self.origins[row]).any() else self.origins[row],
            fitness=None,
            inlier_rmse=None,
            overlap=1.0,
            two_way_inlier_ratio=1.0,
            from_global_search=False,
            uncertainty=Uncertainty(translation=metres, rotation=radians) if stated else None,
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RevisitSite:
    """A building's map, as the pipeline made it."""

    name: str
    reference: ReferenceMap
    seen: Seen
    map_from_world: Matrix4  #: (4, 4) by the best fit of all poses: a map has the frame of its priors
    poses: VisitPoses


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Revisit:
    """A second visit on a map. T tiles: all that either visit, or a true change, has a voxel in."""

    name: str
    points: Points  #: (M, 3) float32, metres, map frame: the survey's cloud, one point a voxel
    seen: Seen
    poses: VisitPoses  #: of the survey
    truth: HitTruth
    tiles: Indices  #: (T, 3) in the map's grid
    misalignment: (
        Floats  #: (T,) metres that the poses put the survey off the map; NaN where either has no point
    )
    sigma: Floats  #: (T,) metres of that which the survey's stored sigmas allow for


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WalkedSite:
    """A building with its map and what only the simulator knows: what its visits are made and judged by."""

    site: RevisitSite
    before: Scene
    taken: tuple[SimulatedScan, ...]  #: of the first visit


def make_visits(
    plans: Sequence[VisitPlan], settings: RevisitSettings, folder: Path, progress: Progress = no_progress
) -> tuple[Path, int]:
    """Make the visits that the folder lacks; return where it lies, and how many had to be made.

    Visits made with other settings lie beside them under another name. Raises MapFailed, and OSError for the folder.
    """
    place = folder / settings.fingerprint
    place.mkdir(parents=True, exist_ok=True)
    made = 0
    for site, group in itertools.groupby(plans, key=lambda plan: plan.site):
        missing = [plan for plan in group if not path_of(plan.name, place).exists()]
        if not missing:
            continue
        with TemporaryDirectory(prefix="spicd-revisit-") as scratch:
            walked = walk_site(site, settings, place, Path(scratch), progress)
            for plan in missing:
                revisit = walk_again(plan, walked, settings, Path(scratch), progress)
                npz.save(path_of(plan.name, place), revisit)
        made += len(missing)
    return place, made


def load_visits(plans: Iterable[VisitPlan], place: Path) -> tuple[Revisit, ...]:
    """Read the visits from where `make_visits` put them. Raises OSError, and ValueError for other files."""
    return tuple(npz.load(path_of(plan.name, place), Revisit) for plan in plans)


def load_site(plan: SitePlan, place: Path) -> RevisitSite:
    """Read the map of a building from there. Raises as `load_visits` does."""
    return npz.load(path_of(plan.name, place), RevisitSite)


def load_parts(plan: SitePlan, place: Path) -> list[Seen]:
    """Read what each part of the map's own scans saw, every sixth scan together. Raises as `load_visits` does."""
    return [npz.load(path, Seen) for path in sorted(place.glob(f"{plan.name}-part-*.npz"))]


def path_of(name: str, place: Path) -> Path:
    """Return the file of plain arrays that a visit or a map is kept in."""
    return place / f"{name}.npz"


def walk_site(
    plan: SitePlan, settings: RevisitSettings, place: Path, scratch: Path, progress: Progress = no_progress
) -> WalkedSite:
    """Simulate the first visit; build the map and keep it, or take the one that was kept. Raises MapFailed.

    The robot's own frame is turned at random against the building: no wall runs along the tiles but by chance.
    """
    progress(f"{plan.name}: simulating the first visit", 0.0)
    scene = plan.scene(settings)
    kept = path_of(plan.name, place)
    taken = visit(
        scene,
        settings.stops[plan.kind],
        seed=20 * plan.seed,
        prior_error=settings.drift,
        drift=drifted_within,
        duration_s=settings.standing_s,
        folder=None if kept.exists() else scratch,
        name="map-{:02d}",
    )
    if not kept.exists():
        site, parts = _mapped(plan, taken, settings, progress)
        for number, part in enumerate(parts):
            npz.save(path_of(f"{plan.name}-part-{number}", place), part)
        npz.save(kept, site)  # last, for it says that all of it is there
    return WalkedSite(site=load_site(plan, place), before=scene, taken=taken)


def _mapped(
    plan: SitePlan, taken: Sequence[SimulatedScan], settings: RevisitSettings, progress: Progress
) -> tuple[RevisitSite, list[Seen]]:
    """Build the map of the scans that were taken; return with it what each of its parts saw."""
    rng = np.random.default_rng([plan.seed, 5])
    robot_from_world = rigid(*rng.uniform(-3, 3, 2), yaw=float(rng.uniform(0, 360)))
    files = _files(taken, robot_from_world, settings)
    titled = StageClock(progress, prefix=f"{plan.name}: ")
    built = build_map(files, settings=settings.pipeline, progress=titled)
    map_from_world = map_frame(built.outcomes, taken)
    scans = list(accepted_scans(files, built.outcomes, settings.pipeline))
    size = built.reference.voxel_size
    site = RevisitSite(
        name=plan.name,
        reference=built.reference,
        seen=Seen.of(scans, voxel_size=size),
        map_from_world=map_from_world,
        poses=VisitPoses.of(built.outcomes, placed_scans(built.outcomes, taken, map_from_world)),
    )
    return site, visits_of((partial(_same_scan, scan) for scan in scans), voxel_size=size)


def _same_scan(scan: RegisteredScan) -> RegisteredScan:
    return scan


def walk_again(
    plan: VisitPlan,
    walked: WalkedSite,
    settings: RevisitSettings,
    scratch: Path,
    progress: Progress = no_progress,
) -> Revisit:
    """Simulate the second visit into a folder, register it to the map, and say what truly changed.

    Its priors are off by as much as the first's, in the frame of the map. Where no scan finds its place, nothing was
    seen. Raises ScanError where a file cannot be read, ValueError where no edits leave a way.
    """
    progress(f"{plan.name}: simulating the second visit", 0.0)
    site = walked.site
    after, poses = walk(plan, walked.before, settings)
    taken = visit(
        after,
        poses,
        seed=plan.seed,
        prior_error=settings.drift,
        drift=drifted_within,
        duration_s=settings.standing_s,
        folder=scratch,
        name=f"{plan.case}-{{:02d}}",
        people=plan.people(settings),
        carrier=carrier_of(plan),
    )
    files = _files(taken, site.map_from_world, settings)
    titled = StageClock(progress, prefix=f"{plan.name}: ")
    outcomes = _pushed(_located(files, site, settings, titled), push_of(plan, settings))
    progress(f"{plan.name}: the truth", 0.5)
    truth = hit_truth(walked.before, after, walked.taken, taken, map_from_world=site.map_from_world)
    return _revisit(plan, walked, files, outcomes, taken, truth, settings)


def _files(
    taken: Sequence[SimulatedScan], target_from_world: Matrix4, settings: RevisitSettings
) -> tuple[ScanFile, ...]:
    """List the files of a visit; what its sensor saw of the robot itself is cut where they are read."""
    files = scan_files(taken, target_from_world)
    return with_carrier(files, settings.pipeline.carrier, max_points=settings.pipeline.max_scan_points)


def _revisit(
    plan: VisitPlan,
    walked: WalkedSite,
    files: Sequence[ScanFile],
    outcomes: Sequence[ScanResult],
    taken: Sequence[SimulatedScan],
    truth: HitTruth,
    settings: RevisitSettings,
) -> Revisit:
    site, size = walked.site, walked.site.reference.voxel_size
    read = list(accepted_scans(files, outcomes, settings.pipeline))
    voxels = fused(scan.voxels(size) for scan in read)
    points = np.empty((0, 3), np.float32) if voxels is None else voxels.points
    grid, tiles = _tiles_of(site, points, truth)
    first = site.poses.placed(walked.taken)
    scans = placed_scans(outcomes, taken, site.map_from_world)
    return Revisit(
        name=plan.name,
        points=points,
        seen=Seen.of(read, voxel_size=size),
        poses=VisitPoses.of(outcomes, scans),
        truth=truth,
        tiles=tiles,
        misalignment=residual_misalignments(first, scans, grid, tiles),
        sigma=stated_sigmas(scans, grid, tiles),
    )


def _tiles_of(site: RevisitSite, points: Points, truth: HitTruth) -> tuple[TileGrid, Indices]:
    """Return all tiles that either visit or a true change touched, and the grid grown to hold them."""
    changed = centers(truth.keys, CELL).astype(np.float32)
    touched = touched_tiles(site.reference.points, np.concatenate([points, changed]), site.reference.grid)
    return touched.grid, touched.indices


def _located(
    files: tuple[ScanFile, ...], site: RevisitSite, settings: RevisitSettings, progress: Progress
) -> tuple[ScanResult, ...]:
    """Register a survey; every scan is left out where none finds its place."""
    try:
        located = locate_survey(files, site.reference, settings=settings.pipeline, progress=progress)
    except NoScanAccepted as nobody:
        return nobody.outcomes
    return located.outcomes


def _pushed(outcomes: Sequence[ScanResult], push: Matrix4) -> tuple[ScanResult, ...]:
    """Move all accepted scans by a shift (4, 4), map frame."""
    return tuple(
        outcome
        if outcome.registration is None
        else replace(outcome, registration=_pushed_one(outcome.registration, push))
        for outcome in outcomes
    )


def _pushed_one(placed: RegistrationResult, push: Matrix4) -> RegistrationResult:
    origin = placed.sensor_origin
    return replace(
        placed,
        map_from_scan=push @ placed.map_from_scan,
        sensor_origin=None if origin is None else origin + push[:3, 3],
    )
