"""Registration: where in the map a scan was taken (paper, Section 3.3.2 and Table 1)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from worker.errors import RegistrationFailed
from worker.pipeline.agreement import Agreement, agreement
from worker.pipeline.constraint import constraint
from worker.pipeline.global_search import candidate_poses
from worker.pipeline.icp import IcpResult, Surface, icp
from worker.pipeline.normals import estimate_normals
from worker.pipeline.poses import difference, exponential, transformed
from worker.pipeline.scan import Scan
from worker.pipeline.values import Floats, Matrix4, Points
from worker.pipeline.visibility import ENOUGH, share_in_front
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
        (0.3, 0.2, 0.15), description="metres; of the global search, in this order; () switches it off"
    )
    search_seeds: int = Field(3, ge=1, description="draws at each resolution")
    min_agreement: float = Field(
        0.8, ge=0, le=1, description="share of the overlap on a common surface, both ways"
    )
    min_agreement_unvouched: float = Field(
        0.85,
        ge=0,
        le=1,
        description="the same where no prior vouches for the pose and the sensor's place is known",
    )
    sure_margin: float = Field(0.03, ge=0, le=1, description="agreement over the least; the search then ends")
    min_overlap: float = Field(0.5, ge=0, le=1, description="share of the scan that the map covers")
    min_overlap_vouched: float = Field(0.3, ge=0, le=1, description="the same near a prior")
    prior_distance: float = Field(1.0, ge=0, description="metres; how far a given prior may be off")
    prior_angle: float = Field(0.26, ge=0, description="radians; likewise (15 degrees)")
    min_constraint: float = Field(0.002, ge=0, description="smallest eigenvalue of the scene's normal matrix")
    min_points: int = Field(500, ge=6, description="voxels that a scan needs to be registered at all")


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


@dataclass(frozen=True, kw_only=True, slots=True)
class _Candidate:
    found: IcpResult
    seen: Agreement
    searched: bool
    vouched: bool  #: near a given prior
    contradicts_prior: bool  #: far from a given prior
    oriented: bool  #: which side of its surfaces the scan saw is known, so that agreement says more


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
    source = _source_surface(scan, settings)
    refine = functools.partial(_refined, source, target, start, settings=settings, tick=tick)
    best = refine(None)
    if not _is_accepted(best, settings):
        best = _searched(source, target, best, start, refine, settings)
    if not _is_accepted(best, settings):
        raise _rejected(scan.name, best, _why_not(best, settings))
    _require_held(scan.name, source, target, best, settings)
    return _placed(scan, best)


def _searched(
    source: Surface,
    target: Surface,
    best: _Candidate,
    prior: Matrix4 | None,
    refine: Callable[[Matrix4], _Candidate],
    settings: RegistrationSettings,
) -> _Candidate:
    """The best pose of the global search, or what was there before it."""
    seeds = settings.search_seeds if prior is None else 1
    candidates = candidate_poses(source, target, resolutions=settings.search_resolutions, seeds=seeds)
    for pose in candidates:
        if prior is not None and not _is_near(pose, prior, settings):
            continue
        best = _better(best, refine(pose))
        if _is_accepted(best, settings) and best.seen.mutual > _needed(best, settings) + settings.sure_margin:
            return best
    if best.searched and not best.vouched and _is_accepted(best, settings):
        for pose in _quarter_turns(source, best.found.target_from_source):
            best = _better(best, refine(pose))
    return best


def _better(best: _Candidate, other: _Candidate) -> _Candidate:
    """The one that agrees with the map over more of the scan; where there is a prior, one near it."""
    return max(best, other, key=lambda each: (not each.contradicts_prior, each.seen.score))


def _quarter_turns(source: Surface, pose: Matrix4) -> Iterator[Matrix4]:
    """A rectangular room fits itself turned about its middle: those poses are tried before one is believed."""
    there = transformed(source.points, pose)
    center = (there.min(axis=0) + there.max(axis=0)) / 2
    for quarter in (1, 2, 3):
        turn = exponential(np.array([0.0, 0.0, quarter * np.pi / 2, 0.0, 0.0, 0.0]))
        turn[:3, 3] = center - turn[:3, :3] @ center
        yield turn @ pose


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


def _source_surface(scan: Scan, settings: RegistrationSettings) -> Surface:
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


def _refined(
    source: Surface,
    target: Surface,
    prior: Matrix4 | None,
    candidate: Matrix4 | None,
    *,
    settings: RegistrationSettings,
    tick: Callable[[], None],
) -> _Candidate:
    """ICP from the candidate, or else the prior, or else identity, through ever smaller gates.

    The wide gates need only a part of the points.
    """
    pose = next((start for start in (candidate, prior) if start is not None), np.eye(4))
    last = settings.max_correspondence_distance
    gates = [gate for gate in settings.coarse_distances if gate > last]
    for level, gate in enumerate([*gates, last]):
        found = icp(
            source,
            target,
            pose,
            max_correspondence_distance=gate,
            max_iterations=settings.max_iterations,
            soft=gate > last,
            every=2 ** (len(gates) - level),
            tick=tick,
        )
        pose = found.target_from_source
    near = prior is not None and _is_near(pose, prior, settings)
    return _Candidate(
        found=found,
        seen=agreement(source, target, pose, reach=REACH, surface_distance=last),
        searched=candidate is not None,
        vouched=near,
        contradicts_prior=prior is not None and not near,
        oriented=bool(source.oriented.mean() > 0.5),
    )


def _is_near(pose: Matrix4, prior: Matrix4, settings: RegistrationSettings) -> bool:
    distance, angle = difference(pose, prior)
    return distance <= settings.prior_distance and angle <= settings.prior_angle


def _is_accepted(candidate: _Candidate, settings: RegistrationSettings) -> bool:
    found, seen = candidate.found, candidate.seen
    overlap = settings.min_overlap_vouched if candidate.vouched else settings.min_overlap
    return (
        not candidate.contradicts_prior
        and (found.fitness > settings.min_fitness or seen.overlap >= overlap)
        and found.inlier_rmse < settings.max_inlier_rmse
        and seen.mutual >= _needed(candidate, settings)
    )


def _needed(candidate: _Candidate, settings: RegistrationSettings) -> float:
    strict = candidate.oriented and not candidate.vouched
    return settings.min_agreement_unvouched if strict else settings.min_agreement


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
        f"(at least {_needed(best, settings):g}) over {best.seen.overlap:.0%} of the scan; "
        + _ADVICE[best.contradicts_prior]
    )


_ADVICE = {
    False: "give an initial pose, or check that the place is in the map",
    True: "it ends far from the pose prior that was given; check the prior, or leave it out",
}


def _require_held(
    name: str, source: Surface, target: Surface, best: _Candidate, settings: RegistrationSettings
) -> None:
    """A scan may be rich and yet share only a plane with the map."""
    there = transformed(source.points, best.found.target_from_source)
    distance, _ = target.nearest(there, within=2 * settings.max_correspondence_distance)
    held = constraint(source.points[np.isfinite(distance)])
    if held < settings.min_constraint:
        reason = (
            f"what it shares with the map leaves a motion free (constraint {held:.4f}, at least "
            f"{settings.min_constraint:g} is needed); scan more of the mapped place"
        )
        raise _rejected(name, best, reason)


def _placed(scan: Scan, best: _Candidate) -> RegisteredScan:
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
    return _placed(
        scan,
        _Candidate(
            found=perfect, seen=seen, searched=False, vouched=True, contradicts_prior=False, oriented=True
        ),
    )
