"""Prepared scans: what registration needs of a scan, made once, kept on disk, loaded when it is its turn.

A surface at voxel spacing, the place that the sensor stood at if the points bear it out, and the ranges it saw. About
0.7 MB a scan, so that the pairs of a 500-scan map never hold all points at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worker.cloud import npz
from worker.cloud.formats.scan import Scan
from worker.cloud.normals import estimate_normals
from worker.cloud.poses import inverse, transformed
from worker.cloud.types import Arrays, Floats, Matrix4
from worker.cloud.visibility import ENOUGH, RangeImage, share_in_front
from worker.cloud.voxels import Voxels
from worker.errors import RegistrationFailed
from worker.pipeline.registration.degeneracy import least_eigenvalue
from worker.pipeline.registration.icp import Surface
from worker.pipeline.registration.settings import RegistrationSettings

#: metres; nearer to its sensor than this a scan sees the robot that carries it, which proves nothing
ROBOT = 1.0


class ScanRejected(RegistrationFailed):
    """One scan found no place; the best numbers that were reached stand beside the reason, None before ICP."""

    def __init__(
        self, reason: str, *, fitness: float | None = None, inlier_rmse: float | None = None
    ) -> None:
        super().__init__(reason)
        self.fitness = fitness  #: 0..1
        self.inlier_rmse = inlier_rmse  #: metres


@dataclass(frozen=True, kw_only=True, slots=True)
class PreparedScan:
    """One scan as registration sees it, scan frame."""

    name: str
    surface: Surface  #: one point a voxel
    image: RangeImage | None  #: what was seen from where; None where the points contradict the file's origin
    sensor_pose: Matrix4  #: (4, 4) scan_from_sensor, as the file has it

    @property
    def origin(self) -> Floats | None:
        """(3,) metres, scan frame: where the sensor stood, if all points can have been seen from there."""
        return None if self.image is None else self.image.origin

    def save(self, path: Path) -> None:
        """Keep it as `.npz`."""
        arrays: Arrays = {
            "points": self.surface.points.astype(np.float32),
            "normals": self.surface.normals.astype(np.float32),
            "oriented": self.surface.oriented,
            "sensor_pose": self.sensor_pose,
            "name": np.array(self.name),
        }
        if self.image is not None:
            arrays |= {"origin": self.image.origin, "ranges": self.image.ranges.astype(np.float32)}
        npz.save_arrays(path, arrays)

    @classmethod
    def load(cls, path: Path) -> PreparedScan:
        """Read what `save` kept, and build the tree."""
        arrays = npz.load_arrays(path)
        image = None
        if "origin" in arrays:
            image = RangeImage(origin=arrays["origin"], ranges=arrays["ranges"].astype(np.float64))
        return cls(
            name=str(arrays["name"]),
            surface=Surface.of(arrays["points"], arrays["normals"], arrays["oriented"]),
            image=image,
            sensor_pose=arrays["sensor_pose"],
        )


def prepare(scan: Scan, settings: RegistrationSettings) -> PreparedScan:
    """The scan at voxel spacing, in its own frame; raises ScanRejected where it cannot be placed anywhere."""
    origin: Floats = scan.sensor_pose[:3, 3]
    trusted = share_in_front(scan.points, origin) >= ENOUGH
    voxels = Voxels.of(scan.points, size=settings.voxel_size, origin=origin if trusted else None)
    points = voxels.points
    if len(points) < settings.min_points:
        raise ScanRejected(
            f"scan {scan.name}: {len(points)} voxels of {settings.voxel_size:g} m are left, "
            f"{settings.min_points} are needed; scan for longer"
        )
    held = least_eigenvalue(points)
    if held < settings.min_eigenvalue:
        raise ScanRejected(
            f"scan {scan.name}: its surfaces leave a motion free (constraint {held:.4f}, at least "
            f"{settings.min_eigenvalue:g} is needed), as a bare plane does; scan a place with more structure"
        )
    return PreparedScan(
        name=scan.name,
        surface=surface_of(voxels, settings),
        image=RangeImage.of(scan.points, origin) if trusted else None,
        sensor_pose=scan.sensor_pose,
    )


def surface_of(voxels: Voxels, settings: RegistrationSettings) -> Surface:
    """The voxels as a target of ICP: normals of Table 1, turned to the side they were seen from."""
    points = voxels.points
    normals = estimate_normals(
        points, radius=settings.normal_radius, max_neighbors=settings.normal_max_neighbors
    )
    views = voxels.views
    normals[np.einsum("ij,ij->i", normals, views) < 0] *= -1
    # seen from nowhere known, or from both sides: a board thinner than a voxel
    oriented = np.linalg.norm(views, axis=1) > 0.3
    return Surface.of(points, normals, oriented)


def free_space_violation(a: PreparedScan, b: PreparedScan, b_from_a: Matrix4, *, every: int = 4) -> float:
    """Share (0..1) of one scan's points that stand where the other saw free space, the worse direction.

    0 where one of the sensors is not known. True poses of simulated scans have 0.000, wrong ones that ICP is content
    with 0.001 to 0.14.
    """
    if a.image is None or b.image is None:
        return 0.0
    return max(_through(a, b.image, b_from_a, every), _through(b, a.image, inverse(b_from_a), every))


def _through(scan: PreparedScan, image: RangeImage, image_from_scan: Matrix4, every: int) -> float:
    points = scan.surface.points[::every]
    if scan.origin is not None:
        points = points[np.linalg.norm(points - scan.origin, axis=1) > ROBOT]
    through = image.free_space_violation(transformed(points, image_from_scan))
    return float(through.mean()) if len(through) else 0.0
