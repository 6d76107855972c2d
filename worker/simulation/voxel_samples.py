"""Samples for the voxel network: buildings edited between two visits, seen by many, few and single scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from worker.cloud.poses import transformed
from worker.cloud.seen import Seen
from worker.cloud.settings import StrictModel
from worker.cloud.types import Bools, Floats, Matrix4, Points
from worker.cloud.voxel_keys import rows_of
from worker.cloud.voxels import Voxels
from worker.detectors.voxels.evidence import EvidenceSettings
from worker.processes import default_processes, open_processes
from worker.progress import Progress, no_progress
from worker.simulation.scenes import BUILDINGS, BuildingKind, Scene, random_solids, rigid
from worker.simulation.sensor import SensorModel, SimulatedScan
from worker.simulation.visits import NEXT_DRAW, edited, stops, visit
from worker.training.voxels.samples import MISSING, THERE, UNKNOWN, VoxelSample, save_samples

FAR = 0.075  #: metres off every surface of the other visit: what stands there is missing from it
_DRAWS = 20  # of edits
CLOSE = 0.03  #: metres; so near to one it is not; what lies between the two is not learned from


class VoxelSampleSettings(StrictModel):
    """Which buildings are visited, and how."""

    buildings: dict[BuildingKind, int] = Field(
        {"office": 12, "corridor": 8, "room": 24}, description="of each kind"
    )
    stops: dict[BuildingKind, int] = Field(
        {"office": 14, "corridor": 16, "room": 6}, description="scans of a whole visit"
    )
    edits: dict[BuildingKind, int] = Field(
        {"office": 9, "corridor": 9, "room": 4}, description="pieces added, removed and moved, in turn"
    )
    solids: dict[BuildingKind, int] = Field(
        {"office": 12, "corridor": 12, "room": 5},
        description="boxes, cylinders and pieces of 12 to 120 cm that are gone, and as many that are new",
    )
    visits: int = Field(2, ge=1, description="to each building, with edits of their own")
    views: int = Field(6, ge=1, description="choices of scans of each pair of visits")
    people: float = Field(0.35, ge=0, le=1, description="share of the visits in which people walk by")
    pose_error: tuple[float, float] = Field(
        (0.012, 0.15),
        description="largest sigma of a scan's shift in metres and yaw in degrees, drawn a visit",
    )
    offset: tuple[float, float] = Field(
        (0.01, 0.05), description="largest shift of a whole visit, metres: usually, and in one of six"
    )
    evidence: EvidenceSettings = EvidenceSettings.model_validate({})
    voxel_size: float = Field(0.05, gt=0, description="metres")
    seed: int = Field(2_000_000, description="of the first building; benchmarks use others")

    def kinds(self) -> list[BuildingKind]:
        """List the kind of every building, in the order of their seeds."""
        return [kind for kind, count in self.buildings.items() for _ in range(count)]


def make_samples(
    settings: VoxelSampleSettings,
    folder: Path,
    progress: Progress = no_progress,
    *,
    processes: int | None = None,
) -> None:
    """Write the samples of every building that has none in the folder yet, as many at a time as there are cores.

    Raises OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kinds = settings.kinds()
    tasks = [
        (number, kind, settings, folder)
        for number, kind in enumerate(kinds)
        if not (folder / f"{number:04d}.done").exists()
    ]
    done = len(kinds) - len(tasks)
    with open_processes(min(processes or default_processes(), len(tasks))) as pool:
        for _ in pool.map_unordered(_write_building, tasks):
            done += 1
            progress("simulate samples", done / len(kinds))


def _write_building(task: tuple[int, BuildingKind, VoxelSampleSettings, Path]) -> None:
    number, kind, settings, folder = task
    samples = building_samples(kind, number, settings)
    save_samples(folder, samples, name=f"{number:04d}")
    (folder / f"{number:04d}.done").touch()


def building_samples(kind: BuildingKind, number: int, settings: VoxelSampleSettings) -> list[VoxelSample]:
    """Visit one building as often as asked, and compare each of these visits with the first, both ways."""
    seed = settings.seed + number
    rng = np.random.default_rng((seed, 11))
    base = BUILDINGS[kind](seed)
    map_from_world = rigid(yaw=float(rng.uniform(0, 360)))
    samples = []
    for again in range(settings.visits):
        walks = _edited_pair(base, kind, seed * 10 + again, settings)
        first = _Visit.made(walks[0], walks[1].scene, map_from_world, settings, rng)
        second = _Visit.made(walks[1], walks[0].scene, map_from_world, settings, rng)
        for view in range(settings.views):
            blind = view == settings.views - 1
            chosen = _view(view, first, second, rng)
            samples += _compared(chosen, number, settings, blind=blind)
    return samples


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Walk:
    """A building as a visit finds it, and where the robot stops."""

    scene: Scene
    poses: tuple[Matrix4, ...]  #: world_from_sensor
    seed: int


def _edited_pair(
    base: Scene, kind: BuildingKind, seed: int, settings: VoxelSampleSettings
) -> tuple[_Walk, _Walk]:
    """Return both visits to a building; edits that leave the robot no way are drawn again."""
    count, most = settings.stops[kind], settings.solids[kind]
    for draw in range(_DRAWS):
        drawn = 2 * (seed + draw * NEXT_DRAW)
        try:
            before, _ = random_solids(base, seed=drawn, count=most, name="gone")
            after, _ = edited(base, settings.edits[kind], seed=drawn, count=count)
            after, _ = random_solids(after, seed=drawn + 1, count=most, name="new")
            return (
                _Walk(scene=before, poses=stops(before, count, seed=drawn), seed=drawn),
                _Walk(scene=after, poses=stops(after, count, seed=drawn + 1), seed=drawn + 1),
            )
        except ValueError:
            most = most * 3 // 4  # fewer things leave more of a way
    raise ValueError(f"{base.name}: no edits leave a way for the robot")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _SeenScan:
    """One scan in the map frame, by a pose that is a little off, with the truth about each point."""

    points: Points
    sensor_origin: Floats
    missing: Bools  #: (N,) what stands there is missing from the other visit
    unclear: Bools  #: (N,) too near to a surface of the other visit to tell
    person: Bools  #: (N,)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Visit:
    scans: tuple[_SeenScan, ...]

    @classmethod
    def made(
        cls,
        walk: _Walk,
        other: Scene,
        map_from_world: Matrix4,
        settings: VoxelSampleSettings,
        rng: np.random.Generator,
    ) -> _Visit:
        """Simulate a visit; what its scene has and `other` has not is labelled as missing."""
        sensor = replace(
            SensorModel(),
            range_sigma=float(rng.uniform(0.005, 0.025)),
            points_per_second=float(rng.choice([10_000, 21_600, 21_600, 40_000])),
        )
        largest = settings.offset[1] if rng.random() < 1 / 6 else settings.offset[0]
        shift = rng.normal(size=3) * [1, 1, 0.3]
        shift *= rng.uniform(0, largest) / np.linalg.norm(shift)
        error = (settings.pose_error[0] * rng.uniform(0.2, 1), settings.pose_error[1] * rng.uniform(0.2, 1))
        people = int(rng.integers(1, 4)) if rng.random() < settings.people else 0
        taken = visit(
            walk.scene,
            walk.poses,
            seed=walk.seed,
            sensor=sensor,
            prior_error=error,
            people=people,
            duration_s=float(rng.uniform(3, 6)),
        )
        offset = rigid(*shift)
        return cls(
            scans=tuple(
                _placed(scan, walk.scene, other, offset @ map_from_world @ scan.prior) for scan in taken
            )
        )


def _placed(scan: SimulatedScan, scene: Scene, other: Scene, map_from_scan: Matrix4) -> _SeenScan:
    gone, near = np.zeros((2, len(scan.points)), bool)
    rows = np.flatnonzero(np.isin(scan.object_ids, _edited_ids(scene, other)))
    if len(rows):
        distance = other.caster.distances(scan.world_points[rows].astype(np.float64))
        gone[rows], near[rows] = distance > FAR, (distance > CLOSE) & (distance <= FAR)
    return _SeenScan(
        points=transformed(scan.points, map_from_scan).astype(np.float32),
        sensor_origin=map_from_scan[:3, 3],
        missing=gone,
        unclear=near,
        person=scan.object_ids < 0,
    )


def _edited_ids(scene: Scene, other: Scene) -> NDArray[np.int32]:
    """Return the ids of what stands in `scene` and not, or elsewhere, in `other`."""
    there = {item.name: item.mesh.vertices for item in other.objects}
    ids = [
        item.object_id
        for item in scene.objects
        if item.name not in there or not np.array_equal(there[item.name], item.mesh.vertices)
    ]
    return np.array(ids, np.int32)


def _view(
    view: int, first: _Visit, second: _Visit, rng: np.random.Generator
) -> tuple[list[_SeenScan], list[_SeenScan]]:
    """Choose scans of both visits: all, a part, a few of one, a few of both, single ones, then any."""
    most = (len(first.scans), len(second.scans))

    def some(visit: _Visit, fewest: int, most: int) -> list[_SeenScan]:
        count = int(rng.integers(min(fewest, most), most + 1))
        start = int(rng.integers(0, len(visit.scans) - count + 1))
        return list(visit.scans[start : start + count])

    if view == 0:
        return list(first.scans), list(second.scans)
    if view == 1:
        return list(first.scans), some(second, most[1] // 3, most[1])
    if view == 2:
        return list(first.scans), some(second, 1, min(3, most[1]))
    if view == 3:
        return some(first, 1, min(3, most[0])), list(second.scans)
    if view == 4:
        start = int(rng.integers(0, min(most)))
        return [first.scans[start]], [second.scans[start]]
    return some(first, most[0] // 2, most[0]), some(second, most[1] // 2, most[1])


def _compared(
    chosen: tuple[Sequence[_SeenScan], Sequence[_SeenScan]],
    building: int,
    settings: VoxelSampleSettings,
    *,
    blind: bool,
) -> list[VoxelSample]:
    sides = [_labelled(scans, settings.voxel_size, blind=blind) for scans in chosen]
    samples = []
    for (own, truth), (other, _) in (sides, sides[::-1]):
        sample = VoxelSample.of(own, other, truth, settings.evidence, building=building)
        if sample is not None:
            samples.append(sample)
    return samples


def _labelled(scans: Sequence[_SeenScan], size: float, *, blind: bool) -> tuple[Seen, NDArray[np.int8]]:
    """Return what a visit saw and the truth (V,) about its voxels: what most returns in a voxel are.

    A person is no change; of one scan alone nobody can tell who walks.
    """
    seen = Seen.of(scans, voxel_size=size)
    if blind:
        seen = replace(seen, sights=None)
    gone, unclear = np.zeros(len(seen.keys)), np.zeros(len(seen.keys))
    for scan in scans:
        rows = rows_of(Voxels.keys_of(scan.points, size=size), seen.keys)
        gone += np.bincount(rows, weights=scan.missing, minlength=len(gone))
        unknown = scan.unclear | scan.person if len(scans) == 1 else scan.unclear
        unclear += np.bincount(rows, weights=unknown, minlength=len(gone))
    truth = np.full(len(gone), UNKNOWN, np.int8)
    truth[(gone == 0) & (unclear == 0)] = THERE
    truth[2 * gone >= seen.hits] = MISSING
    return seen, truth
