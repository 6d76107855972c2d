"""The surveys: what each trial sends to the map, as PCD files, and where each scan truly was taken, if at all there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from worker.benchmarks.placement.plan import BUILDERS, Kind, PlacementSettings, SitePlan, Trial
from worker.benchmarks.placement.sites import PlacementSite
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.poses import inverse, transformed
from worker.cloud.types import Floats, Matrix4, Points
from worker.cloud.voxels import Voxels
from worker.pipeline.registration.results import ScanFile
from worker.simulation.scenes import (
    Scene,
    changed,
    hotel_corridor,
    hotel_room,
    random_room,
    refurnished,
    rigid,
)
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import drifted_within, edited_by, stops, visit

STOPS = 12  #: places along a route of which a survey takes neighbouring ones
SIZE_OFF = 0.04  #: metres at most that a room of the same size is off, along each axis
MOVED, TURNED = 0.5, 10.0  #: metres and degrees by which a moving sensor moves during its scan
OVERLAP = (0.32, 0.50)  #: of a scan that the map covers, in the trials of low overlap
COVERED = 0.1  #: metres to the map within which a point is covered
_CANDIDATES = 24  # stops looked at for that overlap, at most
_FULL_SCALE = 0.015  # a scan that is off by more than this has no right place on the map


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TrialScan:
    """One scan as it is sent."""

    points: Points  #: (N, 3) float32, metres, scan frame
    true: Matrix4 | None  #: (4, 4) map_from_scan; None where it has none: it is of another place, or spoilt
    prior: Matrix4 | None  #: (4, 4) map_from_scan as it is given


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Survey:
    """The files of a trial, and the truth about each."""

    files: tuple[ScanFile, ...]
    true: tuple[Matrix4 | None, ...]  #: map_from_scan
    #: (3,) of each, metres, scan frame: where the error of its pose is measured; left out: at the frame's origin
    middles: tuple[Floats, ...] | None = None


def simulate(trial: Trial, site: PlacementSite, settings: PlacementSettings, folder: Path) -> Survey:
    """Write the scans of a trial as PCD files into a folder; the same trial, the same files. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    scans = trial_scans(trial, site, settings)
    for number, scan in enumerate(scans, start=1):
        path = folder / f"scan-{number}.pcd"
        write_pcd(path, scan.points)
        files.append(ScanFile(name=path.stem, path=path, pose=scan.prior))
    return Survey(files=tuple(files), true=tuple(scan.true for scan in scans))


def trial_scans(trial: Trial, site: PlacementSite, settings: PlacementSettings) -> tuple[TrialScan, ...]:
    """Simulate the scans of a trial."""
    rng = np.random.default_rng([trial.seed, 22])
    if trial.impostor:
        return _elsewhere(trial, site, settings, trial.scans, rng)
    if trial.kind.startswith("mixed"):
        right = _here(replace(trial, scans=trial.scans - 1), site, settings, rng)
        strange = _elsewhere(trial, site, settings, 1, rng)
        mixed = [*right, *strange]
        return tuple(mixed[number] for number in rng.permutation(len(mixed)).tolist())
    spoil = SPOILT.get(trial.kind)
    scans = _here(trial, site, settings, rng)
    return scans if spoil is None else tuple(spoil(scan, trial, rng) for scan in scans)


def other_scene(trial: Trial) -> Scene:
    """Build the other place that a trial has scans of."""
    site, seed = trial.site, trial.seed
    if trial.kind == "twin":
        return edited_by(lambda draw: refurnished(site.scene(), draw), seed, STOPS)[0]
    if trial.kind == "hotel":
        number = trial.other_number
        corridors = site.kind == "hotel-corridor"
        return hotel_corridor(site.seed, floor=number) if corridors else hotel_room(site.seed, number=number)
    if trial.kind == "same-size":
        room = site.scene().rooms[0]
        rng = np.random.default_rng([seed, 23])
        x, y, z = (np.array([*room.high, room.height]) + rng.uniform(-SIZE_OFF, SIZE_OFF, 3)).tolist()
        return random_room(seed, size=(x, y, z))
    return BUILDERS[site.kind](seed)


def covered(points: Points, site: PlacementSite, map_from_scan: Matrix4) -> float:
    """Return the share of a scan's voxels that the map has points at."""
    size = site.reference.voxel_size
    placed = Voxels.of(transformed(points, map_from_scan).astype(np.float32), size=size).points
    away, _ = cKDTree(site.reference.points).query(placed, distance_upper_bound=COVERED, workers=1)
    return float(np.mean(np.isfinite(away)))


def _here(
    trial: Trial, site: PlacementSite, settings: PlacementSettings, rng: np.random.Generator
) -> tuple[TrialScan, ...]:
    """Take right scans, of the place as it is after its edits."""
    before, share = trial.site.scene(), trial.amount if trial.kind in ("right", "low-overlap") else 0.0
    count = _CANDIDATES if trial.kind == "low-overlap" else STOPS
    after, poses = edited_by(lambda draw: changed(before, share, seed=draw), trial.seed, count)
    if trial.kind == "low-overlap":
        taken = _half_covered(trial.site, after, poses, site, settings, trial.seed, rng)
    else:
        taken = _taken(after, _neighbours(poses, trial.scans, rng), settings, trial.seed)
    truths = [site.map_from_world @ scan.world_from_sensor for scan in taken]
    return tuple(
        TrialScan(points=scan.points, true=true, prior=_prior(trial, true, settings, rng))
        for scan, true in zip(taken, truths, strict=True)
    )


def _elsewhere(
    trial: Trial, site: PlacementSite, settings: PlacementSettings, scans: int, rng: np.random.Generator
) -> tuple[TrialScan, ...]:
    """Take scans of another place; their priors put the first at a stop of the map, the others as they truly lie."""
    scene = other_scene(trial)
    taken = _taken(
        scene, _neighbours(stops(scene, STOPS, seed=trial.seed), scans, rng), settings, trial.seed + 1
    )
    first = site.stops[int(rng.integers(len(site.stops)))]
    map_from_other = site.map_from_world @ first @ inverse(taken[0].world_from_sensor)
    priors = [
        drifted_within(map_from_other @ scan.world_from_sensor, settings.drift, rng) if trial.prior else None
        for scan in taken
    ]
    return tuple(
        TrialScan(points=scan.points, true=None, prior=prior)
        for scan, prior in zip(taken, priors, strict=True)
    )


def _taken(
    scene: Scene, poses: Sequence[Matrix4], settings: PlacementSettings, seed: int
) -> tuple[SimulatedScan, ...]:
    return visit(scene, tuple(poses), seed=seed, duration_s=settings.standing_s)


def _neighbours(poses: Sequence[Matrix4], scans: int, rng: np.random.Generator) -> tuple[Matrix4, ...]:
    """Choose so many neighbouring stops."""
    first = int(rng.integers(len(poses) - scans + 1))
    return tuple(poses[first : first + scans])


def _half_covered(
    plan: SitePlan,
    scene: Scene,
    poses: Sequence[Matrix4],
    site: PlacementSite,
    settings: PlacementSettings,
    seed: int,
    rng: np.random.Generator,
) -> tuple[SimulatedScan, ...]:
    """Take the scan of which the map covers 30 to 50%, or as near to that as there is among the stops."""
    best: tuple[float, SimulatedScan] | None = None
    for number in rng.permutation(len(poses)).tolist():
        (scan,) = _taken(scene, (poses[number],), settings, seed + number)
        share = covered(scan.points, site, site.map_from_world @ scan.world_from_sensor)
        off = max(OVERLAP[0] - share, share - OVERLAP[1], 0.0)
        if best is None or off < best[0]:
            best = off, scan
        if off == 0.0:
            break
    if best is None:
        raise ValueError(f"{plan.name} has no stops")
    return (best[1],)


def _prior(
    trial: Trial, true: Matrix4, settings: PlacementSettings, rng: np.random.Generator
) -> Matrix4 | None:
    """Return map_from_scan as it is given: near the truth, or off as the kind has it."""
    if not trial.prior:
        return None
    if trial.kind not in ("prior-off", "prior-turned"):
        return drifted_within(true, settings.drift, rng)
    off, way = true.copy(), rng.uniform(0, 2 * np.pi)
    if trial.kind == "prior-off":
        off[:2, 3] += trial.amount * np.array([np.cos(way), np.sin(way)])
    else:
        yaw = trial.amount or float(rng.uniform(20, 340))
        off[:3, :3] = rigid(yaw=yaw)[:3, :3] @ off[:3, :3]
    return off


Spoil = Callable[[TrialScan, Trial, np.random.Generator], TrialScan]


def _mirrored(scan: TrialScan, _trial: Trial, _rng: np.random.Generator) -> TrialScan:
    return replace(scan, points=scan.points * np.array([-1, 1, 1], np.float32), true=None)


def _scaled(scan: TrialScan, trial: Trial, _rng: np.random.Generator) -> TrialScan:
    true = None if abs(trial.amount - 1) > _FULL_SCALE else scan.true
    return replace(scan, points=scan.points * np.float32(trial.amount), true=true)


def _tilted(scan: TrialScan, trial: Trial, _rng: np.random.Generator) -> TrialScan:
    """Turn the file's frame about x: a quarter has another axis up, a half is upside down."""
    turned_from_scan = rigid(roll=trial.amount)
    true = None if scan.true is None else scan.true @ inverse(turned_from_scan)
    return replace(scan, points=transformed(scan.points, turned_from_scan).astype(np.float32), true=true)


def _wedge(scan: TrialScan, trial: Trial, rng: np.random.Generator) -> TrialScan:
    """Keep what lies within so many degrees of azimuth, about a direction up to 60 degrees off straight ahead."""
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0])) - rng.uniform(-60, 60)
    return replace(scan, points=scan.points[np.abs((azimuth + 180) % 360 - 180) < trial.amount / 2])


def _thin(scan: TrialScan, trial: Trial, rng: np.random.Generator) -> TrialScan:
    return replace(scan, points=scan.points[rng.random(len(scan.points)) < trial.amount])


def _moving(scan: TrialScan, _trial: Trial, rng: np.random.Generator) -> TrialScan:
    """Move the sensor ahead and turn it while it scans: points are kept in the order in which they were measured.

    The true pose is that of the middle of the scan.
    """
    share = np.linspace(-0.5, 0.5, len(scan.points))
    yaw = np.radians(TURNED) * share
    way = rng.uniform(0, 2 * np.pi)
    shifted = scan.points[:, :2] - MOVED * share[:, None] * np.array([np.cos(way), np.sin(way)])
    x = np.cos(yaw) * shifted[:, 0] + np.sin(yaw) * shifted[:, 1]
    y = np.cos(yaw) * shifted[:, 1] - np.sin(yaw) * shifted[:, 0]
    points: Floats = np.stack([x, y, scan.points[:, 2]], axis=1)
    return replace(scan, points=points.astype(np.float32))


#: What a kind does to a right scan.
SPOILT: Mapping[Kind, Spoil] = {
    "mirrored": _mirrored,
    "scaled": _scaled,
    "tilted": _tilted,
    "wedge": _wedge,
    "thin": _thin,
    "moving": _moving,
}
