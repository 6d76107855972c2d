"""Registration: where in the map a scan was taken (paper, Section 3.3.2 and Table 1)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from worker.errors import RegistrationFailed
from worker.pipeline.agreement import Agreement
from worker.pipeline.candidate import (
    Candidate,
    better,
    is_accepted,
    needed_agreement,
    refined,
    searched,
    turned,
)
from worker.pipeline.constraint import constraint
from worker.pipeline.icp import IcpResult, Surface
from worker.pipeline.normals import estimate_normals
from worker.pipeline.poses import transformed
from worker.pipeline.registration_settings import RegistrationSettings
from worker.pipeline.scan import Scan
from worker.pipeline.values import Floats, Matrix4, Points
from worker.pipeline.visibility import ENOUGH, share_in_front
from worker.pipeline.voxels import Voxels


class ScanRejected(RegistrationFailed):
    """One scan found no place; the best numbers that were reached stand beside the reason, None before ICP."""

    def __init__(
        self, reason: str, *, fitness: float | None = None, inlier_rmse: float | None = None
    ) -> None:
        super().__init__(reason)
        self.fitness = fitness  #: 0..1
        self.inlier_rmse = inlier_rmse  #: metres


@dataclass(frozen=True, kw_only=True, slots=True)
class RegisteredScan:
    """A scan that was accepted, in the map frame, with the place it was seen from."""

    name: str
    points: Points  #: (N, 3) float32, metres, map frame
    colors: np.ndarray | None  #: (N, 3) uint8
    map_from_scan: Matrix4  #: (4, 4) rigid
    sensor_origin: Floats | None  #: (3,) metres, map frame; None where the points contradict the file's
    fitness: float  #: share of the scan's voxels with a correspondence at the last gate, 0..1
    inlier_rmse: float  #: metres
    overlap: float  #: share of the scan that the map covers, 0..1
    agreement: float  #: share of the overlap on a common surface, worse direction, 0..1
    searched: bool  #: the given start did not do; the pose comes from the global search

    def voxels(self, size: float) -> Voxels:
        """Its points in cells of `size` metres of the map frame."""
        return Voxels.of(self.points, size=size, origin=self.sensor_origin, colors=self.colors)


def register(
    scan: Scan,
    target: Surface,
    *,
    start: Matrix4 | None = None,
    settings: RegistrationSettings,
    tick: Callable[[], None] = lambda: None,
) -> RegisteredScan:
    """Find map_from_scan by ICP from `start` (a prior of map_from_scan; identity if None), else by global search.

    Table 1 alone accepts wrong poses (a room laid over the next one reaches fitness 0.60) and refuses true ones
    of sparse scans (0.48). So both clouds must lie on common surfaces, seen from either side, over half of the
    scan or with Table 1's fitness. A pose near a given prior needs less of it; one far from it is not taken,
    because buildings repeat themselves. See docs/decisions.

    Raises ScanRejected with the best numbers reached, or where the scene cannot hold a pose.
    """
    source = source_surface(scan, settings)
    refine = functools.partial(refined, source, target, start, settings=settings, tick=tick)
    best = refine(None)
    if start is not None and not is_accepted(best, settings):
        # where little is shared the wide gates may drag a good prior away
        narrow = settings.model_copy(update={"coarse_distances": settings.coarse_distances[-1:]})
        best = better(best, refined(source, target, start, None, settings=narrow, tick=tick))
    if not is_accepted(best, settings):
        best = searched(source, target, best, start, refine, settings)
    if is_accepted(best, settings):
        best = turned(source, best, refine)
    else:
        raise _rejected(scan.name, best, _why_not(best, settings))
    _require_held(scan.name, source, target, best, settings)
    return _placed(scan, best)


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


def source_surface(scan: Scan, settings: RegistrationSettings) -> Surface:
    """The scan at voxel spacing, in its own frame; raises ScanRejected where it cannot be placed anywhere."""
    voxels = Voxels.of(scan.points, size=settings.voxel_size, origin=_trusted_origin(scan))
    points = voxels.points
    if len(points) < settings.min_points:
        raise ScanRejected(
            f"scan {scan.name}: {len(points)} voxels of {settings.voxel_size:g} m are left, "
            f"{settings.min_points} are needed; scan for longer"
        )
    held = constraint(points)
    if held < settings.min_constraint:
        raise ScanRejected(
            f"scan {scan.name}: its surfaces leave a motion free (constraint {held:.4f}, at least "
            f"{settings.min_constraint:g} is needed), as a bare plane does; scan a place with more structure"
        )
    return surface_of(voxels, settings)


def _trusted_origin(scan: Scan) -> Floats | None:
    """(3,) metres, scan frame: where the sensor stood, if all points can have been seen from there."""
    origin: Floats = scan.sensor_pose[:3, 3]
    return origin if share_in_front(scan.points, origin) >= ENOUGH else None


def _rejected(name: str, best: Candidate, reason: str) -> ScanRejected:
    rmse = best.found.inlier_rmse
    return ScanRejected(
        f"scan {name}: {reason}",
        fitness=best.found.fitness,
        inlier_rmse=rmse if np.isfinite(rmse) else None,
    )


def _why_not(best: Candidate, settings: RegistrationSettings) -> str:
    return (
        f"fitness {best.found.fitness:.2f} (over {settings.min_fitness:g} is accepted), "
        f"inlier RMSE {best.found.inlier_rmse * 100:.1f} cm, agreement {best.seen.mutual:.2f} "
        f"(at least {needed_agreement(best, settings):g}) over {best.seen.overlap:.0%} of the scan; "
        + _ADVICE[best.contradicts_prior]
    )


_ADVICE = {
    False: "give an initial pose, or check that the place is in the map",
    True: "it ends far from the pose prior that was given; check the prior, or leave it out",
}


def _require_held(
    name: str, source: Surface, target: Surface, best: Candidate, settings: RegistrationSettings
) -> None:
    """A scan may be rich and yet share only a plane with the map."""
    there = transformed(source.points, best.found.target_from_source)
    distance, _ = target.nearest(there, within=settings.max_correspondence_distance)
    held = constraint(source.points[np.isfinite(distance)])
    if held < settings.min_constraint:
        reason = (
            f"what it shares with the map leaves a motion free (constraint {held:.4f}, at least "
            f"{settings.min_constraint:g} is needed); scan more of the mapped place"
        )
        raise _rejected(name, best, reason)


def _placed(scan: Scan, best: Candidate) -> RegisteredScan:
    pose, origin = best.found.target_from_source, _trusted_origin(scan)
    return RegisteredScan(
        name=scan.name,
        points=transformed(scan.points, pose).astype(np.float32),
        colors=scan.colors,
        map_from_scan=pose,
        sensor_origin=None if origin is None else transformed(origin[None], pose)[0],
        fitness=best.found.fitness,
        inlier_rmse=best.found.inlier_rmse,
        overlap=best.seen.overlap,
        agreement=best.seen.mutual,
        searched=best.searched,
    )


def as_reference(scan: Scan, pose: Matrix4) -> RegisteredScan:
    """The scan that a map starts from: placed by definition, so it fits itself perfectly."""
    perfect = IcpResult(
        target_from_source=pose,
        converged=True,
        iterations=0,
        num_inliers=len(scan.points),
        fitness=1.0,
        inlier_rmse=0.0,
    )
    seen = Agreement(overlap=1.0, forward=1.0, backward=1.0)
    return _placed(
        scan,
        Candidate(
            found=perfect, seen=seen, searched=False, vouched=True, contradicts_prior=False, oriented=True
        ),
    )
