"""The first visit: a building is walked, and the pipeline makes a map of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worker.benchmarks.registration.alignment import align
from worker.benchmarks.revisit.misfit import PlacedScan
from worker.benchmarks.revisit.plan import RevisitSettings, SitePlan
from worker.benchmarks.revisit.record import ScanErrors
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.flow import BuiltMap, build_map
from worker.pipeline.registration.results import ScanFile, ScanResult
from worker.progress import Progress, no_progress
from worker.simulation.scenes import Scene, rigid
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import drifted_within, visit


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Site:
    """A building with its map, and the truth about the map."""

    plan: SitePlan
    before: Scene
    built: BuiltMap
    map_from_world: Matrix4  #: (4, 4) by the best fit of all poses: a map has the frame of its priors
    scans: tuple[PlacedScan, ...]  #: of the map
    errors: ScanErrors


def walk_site(
    plan: SitePlan, settings: RevisitSettings, folder: Path, progress: Progress = no_progress
) -> Site:
    """Simulate the first visit into the folder and build the map. Raises MapFailed, NothingToTile.

    The robot's own frame is turned at random against the building: no wall runs along the tiles but by chance.
    """
    progress(f"{plan.name}: simulating the first visit", 0.0)
    scene = plan.scene()
    rng = np.random.default_rng([plan.seed, 5])
    robot_from_world = rigid(*rng.uniform(-3, 3, 2), yaw=float(rng.uniform(0, 360)))
    seen = visit(
        scene,
        settings.stops[plan.kind],
        seed=10 * plan.seed,
        prior_error=settings.drift,
        drift=drifted_within,
        duration_s=settings.standing_s,
    )
    files = written(seen, folder, "map", robot_from_world)
    built = build_map(files, settings=settings.pipeline, progress=prefixed(progress, f"{plan.name}: "))
    accepted = [
        (outcome.registration.map_from_scan, scan.world_from_sensor)
        for outcome, scan in zip(built.outcomes, seen, strict=True)
        if outcome.registration
    ]
    map_from_world = inverse(align([found for found, _ in accepted], [true for _, true in accepted]))
    scans = placed_scans(built.outcomes, seen, map_from_world)
    return Site(
        plan=plan,
        before=scene,
        built=built,
        map_from_world=map_from_world,
        scans=scans,
        errors=errors_of(scans, len(seen)),
    )


def written(
    scans: tuple[SimulatedScan, ...], folder: Path, name: str, target_from_world: Matrix4
) -> tuple[ScanFile, ...]:
    """The scans as files, with their priors in the target frame."""
    files = []
    for number, scan in enumerate(scans, start=1):
        path = folder / f"{name}-{number:02d}.pcd"
        write_pcd(path, scan.points)
        files.append(ScanFile(name=path.stem, path=path, pose=target_from_world @ scan.prior))
    return tuple(files)


def placed_scans(
    outcomes: tuple[ScanResult, ...], scans: tuple[SimulatedScan, ...], map_from_world: Matrix4
) -> tuple[PlacedScan, ...]:
    """Those that were accepted, with their true poses."""
    return tuple(
        PlacedScan(
            points=scan.points,
            placement=outcome.registration,
            true=map_from_world @ scan.world_from_sensor,
        )
        for outcome, scan in zip(outcomes, scans, strict=True)
        if outcome.registration
    )


def errors_of(scans: tuple[PlacedScan, ...], taken: int) -> ScanErrors:
    """Of the accepted scans; `taken` are all."""
    sigmas = [scan.placement.uncertainty for scan in scans]
    return ScanErrors(
        scans=taken,
        metres=np.array([difference(scan.placement.map_from_scan, scan.true)[0] for scan in scans]),
        sigmas=np.array([np.nan if sigma is None else sigma.translation for sigma in sigmas]),
    )


def prefixed(progress: Progress, words: str) -> Progress:
    """The same, with words before each stage's name."""

    def told(stage: str, share: float) -> None:
        progress(words + stage, share)

    return told
