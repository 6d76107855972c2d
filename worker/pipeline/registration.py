"""Registration: where in the map a scan was taken (paper, Section 3.3.2 and Table 1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from worker.errors import RegistrationFailed
from worker.pipeline.agreement import Agreement, agreement
from worker.pipeline.constraint import constraint
from worker.pipeline.global_search import candidate_poses
from worker.pipeline.icp import IcpResult, Surface, icp
from worker.pipeline.normals import estimate_normals
from worker.pipeline.poses import transformed
from worker.pipeline.scan import Scan
from worker.pipeline.values import Floats, Matrix4, Points
from worker.pipeline.voxels import Voxels

REACH = 0.3  #: metres; farther from the map than this, a point is where the map has nothing to say


class ScanRejected(RegistrationFailed):
    """One scan found no place; the best numbers that were reached stand beside the reason, None before ICP."""

    def __init__(
        self, reason: str, *, fitness: float | None = None, inlier_rmse: float | None = None
    ) -> None:
        super().__init__(reason)
        self.fitness = fitness  #: 0..1
        self.inlier_rmse = inlier_rmse  #: metres


class RegistrationSettings(BaseModel):
    """Table 1 of the paper, and what we add to it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    voxel_size: float = Field(0.05, gt=0, le=0.5, description="metres; the scan is sampled before ICP")
    max_correspondence_distance: float = Field(0.05, gt=0, le=1, description="metres; the last gate of ICP")
    normal_radius: float = Field(0.10, gt=0, le=1, description="metres")
    normal_max_neighbors: int = Field(30, ge=3, le=200)
    min_fitness: float = Field(
        0.55, ge=0, le=1, description="share of the scan's points with a correspondence"
    )
    max_inlier_rmse: float = Field(0.05, gt=0, le=1, description="metres")
    coarse_distances: tuple[float, ...] = Field(
        (0.6, 0.3, 0.1), description="metres; earlier gates, so that a start may be half a metre off"
    )
    max_iterations: int = Field(30, ge=1, le=1000, description="of ICP at each gate")
    search_resolutions: tuple[float, ...] = Field(
        (0.1, 0.2, 0.3, 0.15), description="metres; of the global search, in this order; () switches it off"
    )
    min_agreement: float = Field(
        0.8, ge=0, le=1, description="share of the overlap on a common surface, both ways"
    )
    min_overlap: float = Field(0.5, ge=0, le=1, description="share of the scan that the map covers")
    min_constraint: float = Field(0.002, ge=0, description="smallest eigenvalue of the scene's normal matrix")
    min_points: int = Field(500, ge=6, description="voxels that a scan needs to be registered at all")


@dataclass(frozen=True, kw_only=True, slots=True)
class RegisteredScan:
    """A scan that was accepted, in the map frame, with the place it was seen from."""

    name: str
    points: Points  #: (N, 3) float32, metres, map frame
    colors: np.ndarray | None  #: (N, 3) uint8
    map_from_scan: Matrix4  #: (4, 4) rigid
    sensor_origin: Floats  #: (3,) metres, map frame
    fitness: float  #: share of the scan's voxels with a correspondence at the last gate, 0..1
    inlier_rmse: float  #: metres
    overlap: float  #: share of the scan that the map covers, 0..1
    agreement: float  #: share of the overlap on a common surface, worse direction, 0..1
    searched: bool  #: the given start did not do; the pose comes from the global search


@dataclass(frozen=True, kw_only=True, slots=True)
class _Candidate:
    found: IcpResult
    seen: Agreement
    searched: bool


def register(
    scan: Scan,
    target: Surface,
    *,
    start: Matrix4 | None = None,
    settings: RegistrationSettings,
    tick: Callable[[], None] = lambda: None,
) -> RegisteredScan:
    """Find map_from_scan by ICP from `start` (map_from_scan; identity if None), else by global search.

    Accepted is what passes Table 1 (fitness and inlier RMSE), or, because fitness falls with the spacing of
    the points, what lies on common surfaces from both sides (`min_agreement`, `min_overlap`).

    Raises ScanRejected with the best numbers reached, or where the scene cannot hold a pose.
    """
    source = _source_surface(scan, settings)
    begin = np.eye(4) if start is None else start
    best = _refined(source, target, begin, searched=False, settings=settings, tick=tick)
    if not _passes_table_1(best.found, settings):
        for pose in candidate_poses(source.points, target.points, resolutions=settings.search_resolutions):
            tick()
            other = _refined(source, target, pose, searched=True, settings=settings, tick=tick)
            best = max(best, other, key=lambda candidate: candidate.seen.score)
            if best.searched and _is_accepted(best, settings):
                break
    if not _is_accepted(best, settings):
        raise _rejected(scan.name, best, _why_not(best, settings))
    _require_held(scan.name, source, target, best, settings)
    return _placed(scan, best)


def surface_of(points: Points, settings: RegistrationSettings) -> Surface:
    """Points (N, 3), already at voxel spacing, with normals of Table 1 and a tree."""
    normals = estimate_normals(
        points, radius=settings.normal_radius, max_neighbors=settings.normal_max_neighbors
    )
    return Surface.of(points, normals)


def _source_surface(scan: Scan, settings: RegistrationSettings) -> Surface:
    points = Voxels.of(scan.points, size=settings.voxel_size).points
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
    return surface_of(points, settings)


def _refined(
    source: Surface,
    target: Surface,
    start: Matrix4,
    *,
    searched: bool,
    settings: RegistrationSettings,
    tick: Callable[[], None],
) -> _Candidate:
    """ICP through ever smaller gates; the wide ones need only a part of the points."""
    pose = start
    gates = [gate for gate in settings.coarse_distances if gate > settings.max_correspondence_distance]
    for level, gate in enumerate(gates):
        some = source.points[:: 2 ** (len(gates) - level)]
        coarse = icp(
            some,
            target,
            pose,
            max_correspondence_distance=gate,
            max_iterations=settings.max_iterations,
            tick=tick,
        )
        pose = coarse.target_from_source
    found = icp(
        source.points,
        target,
        pose,
        max_correspondence_distance=settings.max_correspondence_distance,
        max_iterations=settings.max_iterations,
        tick=tick,
    )
    seen = agreement(
        source,
        target,
        found.target_from_source,
        reach=REACH,
        surface_distance=settings.max_correspondence_distance,
    )
    return _Candidate(found=found, seen=seen, searched=searched)


def _passes_table_1(found: IcpResult, settings: RegistrationSettings) -> bool:
    return found.fitness > settings.min_fitness and found.inlier_rmse < settings.max_inlier_rmse


def _is_accepted(candidate: _Candidate, settings: RegistrationSettings) -> bool:
    seen = candidate.seen
    on_common_surfaces = seen.mutual >= settings.min_agreement and seen.overlap >= settings.min_overlap
    return _passes_table_1(candidate.found, settings) or (
        on_common_surfaces and candidate.found.inlier_rmse < settings.max_inlier_rmse
    )


def _rejected(name: str, best: _Candidate, reason: str) -> ScanRejected:
    rmse = best.found.inlier_rmse
    return ScanRejected(
        f"scan {name}: {reason}",
        fitness=best.found.fitness,
        inlier_rmse=rmse if np.isfinite(rmse) else None,
    )


def _why_not(best: _Candidate, settings: RegistrationSettings) -> str:
    return (
        f"fitness {best.found.fitness:.2f} (over {settings.min_fitness:g} is accepted), "
        f"inlier RMSE {best.found.inlier_rmse * 100:.1f} cm, agreement {best.seen.mutual:.2f} "
        f"(at least {settings.min_agreement:g}) over {best.seen.overlap:.0%} of the scan; "
        "give an initial pose, or check that the place is in the map"
    )


def _require_held(
    name: str, source: Surface, target: Surface, best: _Candidate, settings: RegistrationSettings
) -> None:
    """A scan may be rich and yet share only a plane with the map."""
    distance, _ = target.nearest(transformed(source.points, best.found.target_from_source), within=REACH)
    held = constraint(source.points[np.isfinite(distance)])
    if held < settings.min_constraint:
        reason = (
            f"what it shares with the map leaves a motion free (constraint {held:.4f}, at least "
            f"{settings.min_constraint:g} is needed); scan more of the mapped place"
        )
        raise _rejected(name, best, reason)


def _placed(scan: Scan, best: _Candidate) -> RegisteredScan:
    pose = best.found.target_from_source
    return RegisteredScan(
        name=scan.name,
        points=transformed(scan.points, pose).astype(np.float32),
        colors=scan.colors,
        map_from_scan=pose,
        sensor_origin=(pose @ scan.sensor_pose)[:3, 3],
        fitness=best.found.fitness,
        inlier_rmse=best.found.inlier_rmse,
        overlap=best.seen.overlap,
        agreement=best.seen.mutual,
        searched=best.searched,
    )


def as_reference(scan: Scan, pose: Matrix4) -> RegisteredScan:
    """The scan that a map starts from: placed by definition, so its numbers are those of a perfect match."""
    perfect = IcpResult(
        target_from_source=pose,
        converged=True,
        iterations=0,
        num_inliers=len(scan.points),
        fitness=1.0,
        inlier_rmse=0.0,
    )
    seen = Agreement(overlap=1.0, forward=1.0, backward=1.0)
    return _placed(scan, _Candidate(found=perfect, seen=seen, searched=False))
