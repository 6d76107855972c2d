"""Scans of the simulated room as files and as prepared scans, a corridor's points, and how far poses are off.

Scans are thinned, so that a test takes no longer than it must.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.support.rooms import as_scan
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.poses import difference, inverse, transformed
from worker.cloud.types import Matrix4, Points
from worker.pipeline.mapping.settings import JointRegistrationSettings, MappingSettings
from worker.pipeline.mapping.tasks import Folder, downsample
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.results import RegistrationResult, ScanFile, ScanResult
from worker.pipeline.registration.settings import RegistrationSettings
from worker.simulation.sensor import SimulatedScan

THIN = 3  #: every third point of a scan does here
MANY = 1_000_000
FREE = np.array([2.7, 1.45, 1.6])  #: metres, world frame: the emptiest place of the room
#: without the slow part of the global search; BEV candidates are still asked
QUICK = RegistrationSettings(max_iterations=12, search_resolutions=(0.3,), search_seeds=1)


def joint_settings(registration: RegistrationSettings = QUICK, **mapping: float) -> JointRegistrationSettings:
    """Return these settings together, with some of the map's changed."""
    return JointRegistrationSettings(
        registration=registration, mapping=MappingSettings().model_copy(update=mapping), max_points=MANY
    )


def written(
    path: Path,
    scan: SimulatedScan,
    *,
    between: tuple[float, float] = (-np.inf, np.inf),
    pose: Matrix4 | None = None,
    viewpoint: Matrix4 | None = None,
    more: Points | None = None,
    thinned: int = THIN,
) -> ScanFile:
    """What the scan saw for x of the world in `between`, and `more` (N, 3) of the sensor frame.

    `pose` is the prior that is given, `viewpoint` where the sensor stood in the frame of the file.
    """
    x = scan.world_points[::thinned, 0]
    points = scan.points[::thinned][(x > between[0]) & (x < between[1])].astype(np.float64)
    if more is not None:
        points = np.concatenate([points, more])
    if viewpoint is not None:
        points = points @ viewpoint[:3, :3].T + viewpoint[:3, 3]
    write_pcd(path, points.astype(np.float32), sensor_pose=viewpoint)
    return ScanFile(name=path.name, path=path, pose=pose)


def hanging(scan: SimulatedScan, *, size: float) -> Points:
    """(N, 3) sensor frame: a board of `size` metres upright in the air of the room, where nothing is within 1.3 m."""
    side = np.arange(-size / 2, size / 2, 0.025)
    across, up = (each.ravel() for each in np.meshgrid(side, side))
    board = FREE + np.column_stack([across, np.zeros_like(across), up])
    points: Points = transformed(board, inverse(scan.world_from_sensor)).astype(np.float32)
    return points


def corridor_points(*, ends: bool, seed: int, half: float = 5.0) -> Points:
    """Floor, ceiling and walls 2.2 m apart along x, `half` metres each way; with end walls or without."""
    rng = np.random.default_rng(seed)
    x, across = rng.uniform(-half, half, (4, 5000)), rng.uniform(-1.1, 1.1, (4, 5000))
    up = rng.uniform(-0.35, 2.2, (4, 5000))
    parts = [
        np.column_stack([x[0], across[0], np.full(5000, -0.35)]),
        np.column_stack([x[1], across[1], np.full(5000, 2.2)]),
        np.column_stack([x[2], np.full(5000, -1.1), up[2]]),
        np.column_stack([x[3], np.full(5000, 1.1), up[3]]),
    ]
    if ends:
        parts += [
            np.column_stack([np.full(2500, side * half), across[side][:2500], up[side][:2500]])
            for side in (-1, 1)
        ]
    points = np.concatenate(parts) + rng.normal(0, 0.01, (sum(map(len, parts)), 3))
    return points.astype(np.float32)


def prepared_folder(root: Path, scans: Mapping[int, SimulatedScan]) -> tuple[Folder, dict[int, Points]]:
    """The scans prepared under their numbers, and their thinned points."""
    folder, points = Folder(root=root), {}
    for number, scan in scans.items():
        ready = prepare(as_scan(scan.points[::THIN], name=f"{number}.pcd"), QUICK)
        ready.save(folder.path(number))
        points[number] = downsample(ready.surface.points)
    return folder, points


def registered(outcome: ScanResult) -> RegistrationResult:
    """Return the registration of a scan that must have been accepted."""
    assert outcome.registration is not None, outcome.reason
    assert outcome.reason is None
    return outcome.registration


def off(pose: Matrix4, truth: Matrix4) -> float:
    """Metres."""
    return difference(pose, truth)[0]


def spread(poses: Mapping[int, Matrix4], truth: Mapping[int, Matrix4]) -> float:
    """Metres that two scans are off each other at most."""
    return max(off(inverse(poses[a]) @ poses[b], inverse(truth[a]) @ truth[b]) for a in poses for b in poses)


def never_falls(told: Sequence[tuple[str, float]]) -> bool:
    """Whether each stage's shares only rise."""
    shares: dict[str, list[float]] = {}
    for stage, share in told:
        shares.setdefault(stage, []).append(share)
    return all(each == sorted(each) and each[-1] <= 1 for each in shares.values())
