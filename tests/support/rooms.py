"""A simulated furnished room that was scanned twice, points as a scan, a wall, and scores as a detection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from worker.cloud.formats.scan import Scan
from worker.cloud.types import Matrix4, Points
from worker.cloud.voxels import Voxels
from worker.detectors.detector import Detection
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, surface_of
from worker.simulation.scenes import random_room
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit


@dataclass(frozen=True)
class Room:
    """Two visits to one room; the world is the map frame."""

    before: tuple[SimulatedScan, ...]
    after: tuple[SimulatedScan, ...]
    target: Surface

    def scan(self, number: int = 0, *, name: str = "now.pcd") -> Scan:
        """A scan of the second visit, in its sensor's frame."""
        return as_scan(self.after[number].points, name=name)


def as_scan(points: Points, *, name: str = "scan.pcd", sensor_pose: Matrix4 | None = None) -> Scan:
    pose = np.eye(4) if sensor_pose is None else sensor_pose
    return Scan(name=name, points=points, colors=None, sensor_pose=pose, n_dropped=0)


def simulated_room() -> Room:
    """Four scans before, two after, nothing changed."""
    scene = random_room(3)
    before, after = visit(scene, 4, seed=1), visit(scene, 2, seed=2)
    fused: Voxels | None = None
    for each in before:
        origin = each.world_from_sensor[:3, 3]
        voxels = Voxels.of(each.world_points, size=0.05, origin=origin)
        fused = voxels if fused is None else fused.merged(voxels)
    assert fused is not None
    return Room(before=before, after=after, target=surface_of(fused, RegistrationSettings()))


def scores_of(*rows: tuple[float, float, float]) -> Detection:
    return Detection(probabilities=np.array(rows, np.float32))


def wall(x: float, *, y: tuple[float, float] = (-2.0, 2.0)) -> np.ndarray:
    """4 m high, across the x axis, a point every 2 cm."""
    across, up = np.meshgrid(np.arange(*y, 0.02), np.arange(-2, 2, 0.02))
    return np.column_stack([np.full(across.size, x), across.ravel(), up.ravel()])
