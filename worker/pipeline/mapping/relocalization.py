"""A second chance: scans that no single scan wanted are looked for in the map of all that were placed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import inverse
from worker.cloud.types import Matrix4
from worker.pipeline.mapping.frame import map_from_reference
from worker.pipeline.mapping.pair_registration import PairWork, ValidScan
from worker.pipeline.mapping.tasks import Folder, assembled
from worker.pipeline.registration.preprocessing import PreparedScan, ScanRejected, free_space_violation
from worker.pipeline.registration.results import RegistrationResult
from worker.pipeline.registration.scan_to_map import placement_of, register
from worker.pipeline.registration.settings import RegistrationSettings

_FEW = 4  # placed scans up to which the whole search is worth its time
_NEAR = 6.0  # metres between sensors, within which one scan can speak of another


@dataclass(frozen=True, kw_only=True, slots=True)
class Relocalized:
    """What became of one scan that was left over."""

    number: int
    pose: Matrix4 | None = None  #: in the frame of the poses that were given; None where it has no place
    beside: int = -1  #: the placed scan nearest to it
    placement: RegistrationResult | None = None  #: its numbers
    reason: str | None = None
    fitness: float | None = None
    inlier_rmse: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class _Looking:
    folder: Folder
    map_number: int  #: of what the scan is looked for in
    number: int
    start: Matrix4 | None
    poses: tuple[tuple[int, Matrix4], ...]
    settings: RegistrationSettings


def relocalize(
    missing: Sequence[int],
    poses: Mapping[int, Matrix4],
    reference: int,
    scans: Mapping[int, ValidScan],
    work: PairWork,
) -> dict[int, Relocalized]:
    """Register each missing scan to the placed ones as a survey is registered to a map; all in one frame."""
    if not missing:
        return {}
    surface = assembled(work.folder, list(poses.items()), voxel_size=work.registration.voxel_size)
    # Below every scan's, and a new one whenever the map has grown: processes keep what they loaded.
    map_number = -len(poses)
    PreparedScan(name="map", surface=surface, image=None, sensor_pose=np.eye(4)).save(
        work.folder.path(map_number)
    )
    priors = {number: scan.prior for number, scan in scans.items() if scan.prior is not None}
    frame = inverse(map_from_reference(poses, priors, reference))
    tasks = [
        _Looking(
            folder=work.folder,
            map_number=map_number,
            number=number,
            start=frame @ priors[number] if number in priors else None,
            poses=tuple(poses.items()),
            settings=_hurried(work.registration) if len(poses) > _FEW else work.registration,
        )
        for number in missing
    ]
    return {each.number: each for each in work.processes.each(_look, tasks)}


def _hurried(settings: RegistrationSettings) -> RegistrationSettings:
    """One draw of features: these scans have been looked for in every placed scan already."""
    return settings.model_copy(
        update={"search_resolutions": settings.search_resolutions[:1], "search_seeds": 1}
    )


def _look(task: _Looking) -> Relocalized:
    scan, target = task.folder.load(task.number), task.folder.load(task.map_number).surface
    try:
        best = register(scan, target, start=task.start, settings=task.settings)
    except ScanRejected as error:
        return Relocalized(
            number=task.number, reason=str(error), fitness=error.fitness, inlier_rmse=error.inlier_rmse
        )
    pose = best.found.target_from_source
    near = _by_distance(pose, task.poses)
    through = _contradicted(scan, pose, near, task.folder)
    limit = (
        task.settings.max_free_space_violation_near_prior
        if best.consistent_with_prior
        else task.settings.max_free_space_violation
    )
    if through > limit:
        reason = (
            f"scan {scan.name}: {through:.1%} of its points stand where its neighbours saw free space (at most "
            f"{limit:.1%} is accepted); {'check its pose prior' if best.consistent_with_prior else 'give an initial pose'}, "
            "or scan there again"
        )
        return Relocalized(
            number=task.number,
            reason=reason,
            fitness=best.found.fitness,
            inlier_rmse=best.found.inlier_rmse,
        )
    return Relocalized(
        number=task.number, pose=pose, beside=near[0][0], placement=placement_of(best, scan.origin)
    )


def _by_distance(pose: Matrix4, poses: Sequence[tuple[int, Matrix4]]) -> list[tuple[int, Matrix4]]:
    return sorted(poses, key=lambda other: float(np.linalg.norm(other[1][:3, 3] - pose[:3, 3])))


def _contradicted(
    scan: PreparedScan, pose: Matrix4, near: Sequence[tuple[int, Matrix4]], folder: Folder
) -> float:
    """Mean share of points in free space over the placed scans that are near enough to say so."""
    beside = [other for other in near if np.linalg.norm(other[1][:3, 3] - pose[:3, 3]) < _NEAR]
    shares = [
        free_space_violation(scan, folder.load(number), inverse(other) @ pose) for number, other in beside[:8]
    ]
    return float(np.mean(shares)) if shares else 0.0
