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
from worker.cloud.sight import Sights
from worker.cloud.types import Arrays, Floats, Matrix4
from worker.cloud.visibility import ENOUGH, RangeImage, share_in_front
from worker.cloud.voxels import Voxels
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, least_eigenvalue, surface_of


@dataclass(frozen=True, kw_only=True, slots=True)
class PreparedScan:
    """One scan as registration sees it, scan frame."""

    name: str
    surface: Surface  #: one point a voxel
    image: RangeImage | None  #: what was seen from where; None where the points contradict the file's origin
    sensor_pose: Matrix4  #: (4, 4) scan_from_sensor, as the file has it
    sights: Sights | None = (
        None  #: the same as the image, finer, with the farthest returns; where it was asked for
    )

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
        if self.sights is not None:
            sights = self.sights
            arrays |= {"seen_from": sights.origins, "nearest": sights.nearest, "farthest": sights.farthest}
        npz.save_arrays(path, arrays)

    @classmethod
    def load(cls, path: Path) -> PreparedScan:
        """Read what `save` kept, and build the tree."""
        arrays = npz.load_arrays(path)
        image = sights = None
        if "origin" in arrays:
            image = RangeImage(origin=arrays["origin"], ranges=arrays["ranges"].astype(np.float64))
        if "nearest" in arrays:
            sights = Sights(
                origins=arrays["seen_from"], nearest=arrays["nearest"], farthest=arrays["farthest"]
            )
        return cls(
            name=str(arrays["name"]),
            surface=Surface.of(arrays["points"], arrays["normals"], arrays["oriented"]),
            image=image,
            sensor_pose=arrays["sensor_pose"],
            sights=sights,
        )


def prepare(scan: Scan, settings: RegistrationSettings, *, with_sights: bool = False) -> PreparedScan:
    """Sample the scan to voxels in its own frame, and on request keep how far it saw, to judge poses by.

    Raises ScanRejected where it cannot be registered to anything.
    """
    origin: Floats = scan.sensor_pose[:3, 3]
    # where an offset was taken off, the file's origin is far away, and its own frame's is no sensor's place
    trusted = not scan.offset.any() and share_in_front(scan.points, origin) >= ENOUGH
    voxels = Voxels.of(scan.points, size=settings.voxel_size, origin=origin if trusted else None)
    points = voxels.points
    if len(points) < settings.min_points:
        raise ScanRejected.because(
            "too_few_points",
            f"scan {scan.name}: {len(points)} voxels of {settings.voxel_size:g} m are left, "
            f"{settings.min_points} are needed; scan for longer",
            voxels=len(points),
        )
    eigenvalue = least_eigenvalue(points)
    if eigenvalue < settings.min_eigenvalue:
        raise ScanRejected.because(
            "degenerate",
            f"scan {scan.name}: its surfaces leave a motion free (least eigenvalue {eigenvalue:.4f}, at least "
            f"{settings.min_eigenvalue:g} is needed), as a bare plane does; scan a place with more structure",
            least_eigenvalue=eigenvalue,
        )
    return PreparedScan(
        name=scan.name,
        surface=surface_of(voxels, settings),
        image=RangeImage.of(scan.points, origin) if trusted else None,
        sensor_pose=scan.sensor_pose,
        sights=Sights.of([(scan.points, origin)]) if trusted and with_sights else None,
    )
