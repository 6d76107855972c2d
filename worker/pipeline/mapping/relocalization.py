"""Relocalization: scans that no pair led to are looked for in the map of all that were registered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import inverse
from worker.cloud.types import Matrix4
from worker.pipeline.mapping.pose_graph import map_from_reference
from worker.pipeline.mapping.tasks import Folder, ValidScan, Workspace, lay_together
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.results import ScanRejected, ScanResult
from worker.pipeline.registration.scan_to_map import register, registration_result
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.verification import free_space_violation, rejected

_FEW = 4  # registered scans up to which the whole search is worth its time
_NEAR = 6.0  # metres between sensors, within which one scan can speak of another
_NEIGHBOURS = 8  # that are asked at most

IndexedPose = tuple[int, Matrix4]


@dataclass(frozen=True, kw_only=True, slots=True)
class Relocalized:
    """What became of one scan that was left over."""

    index: int  #: of the file
    result: ScanResult  #: accepted, in the frame of the poses that were given, or rejected
    nearest: int = -1  #: the registered scan nearest to it; -1 where it has no place

    @property
    def pose(self) -> Matrix4 | None:
        """In the frame of the poses that were given; None where it has no place."""
        return None if self.result.registration is None else self.result.registration.map_from_scan


@dataclass(frozen=True, kw_only=True, slots=True)
class _RelocalizeTask:
    folder: Folder
    map_index: int  #: of what the scan is looked for in
    index: int
    prior: Matrix4 | None  #: map_from_scan
    poses: tuple[IndexedPose, ...]  #: of the registered scans
    settings: RegistrationSettings


def relocalize(
    missing: Sequence[int],
    poses: Mapping[int, Matrix4],
    reference: int,
    scans: Mapping[int, ValidScan],
    workspace: Workspace,
) -> dict[int, Relocalized]:
    """Register each missing scan to the registered ones as a survey is registered to a map; all in one frame."""
    if not missing:
        return {}
    settings = workspace.settings.registration
    surface = lay_together(workspace.folder, list(poses.items()), voxel_size=settings.voxel_size)
    # Below every scan's, and a new one whenever the map has grown: processes keep what they loaded.
    map_index = -len(poses)
    workspace.folder.save_map(map_index, surface)
    if len(poses) > _FEW:
        # one draw of features: these scans have been looked for in every registered scan already
        first = settings.search_resolutions[:1]
        settings = settings.with_values(search_resolutions=first, search_seeds=1)
    priors = {index: scan.prior for index, scan in scans.items() if scan.prior is not None}
    reference_from_map = inverse(map_from_reference(poses, priors, reference))
    tasks = [
        _RelocalizeTask(
            folder=workspace.folder,
            map_index=map_index,
            index=index,
            prior=reference_from_map @ priors[index] if index in priors else None,
            poses=tuple(poses.items()),
            settings=settings,
        )
        for index in missing
    ]
    return {attempt.index: attempt for attempt in workspace.processes.map_unordered(_relocalize_one, tasks)}


def _relocalize_one(task: _RelocalizeTask) -> Relocalized:
    scan, target = task.folder.load(task.index), task.folder.load(task.map_index).surface
    try:
        hypothesis = register(scan, target, prior=task.prior, settings=task.settings)
        pose = hypothesis.target_from_source
        near = sorted(task.poses, key=lambda other: _apart(other[1], pose))
        _require_free_space(scan, hypothesis, near, task)
    except ScanRejected as error:
        return Relocalized(index=task.index, result=ScanResult.rejected(scan.name, error))
    result = ScanResult.accepted(scan.name, registration_result(hypothesis, scan.origin))
    return Relocalized(index=task.index, result=result, nearest=near[0][0])


def _require_free_space(
    scan: PreparedScan, hypothesis: Hypothesis, near: Sequence[IndexedPose], task: _RelocalizeTask
) -> None:
    """Raise ScanRejected where the mean violation over the neighbours near enough to say so is too high."""
    pose = hypothesis.target_from_source
    neighbours = [other for other in near if _apart(other[1], pose) < _NEAR][:_NEIGHBOURS]
    shares = [
        free_space_violation(scan, task.folder.load(index), inverse(other) @ pose)
        for index, other in neighbours
    ]
    violation = float(np.mean(shares)) if shares else 0.0
    limit = hypothesis.free_space_limit(task.settings)
    if violation > limit:
        advice = "check its pose prior" if hypothesis.consistent_with_prior else "give an initial pose"
        raise rejected(
            scan.name,
            hypothesis,
            "other_place",
            f"{violation:.1%} of its points stand where its neighbours saw free space (at most {limit:.1%} is "
            f"accepted); {advice}, or scan there again",
        )


def _apart(a: Matrix4, b: Matrix4) -> float:
    """Return the metres between two places."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
