"""What the processes of a map build do: one function a kind of work, each on scans that lie prepared in a folder."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from worker.cloud.poses import inverse
from worker.cloud.types import Floats, Matrix4, Points
from worker.cloud.voxels import Voxels
from worker.errors import ScanError
from worker.pipeline.mapping.pose_graph_optimization import Factor
from worker.pipeline.registration import bev_correlation
from worker.pipeline.registration.hypothesis import CoarsePose
from worker.pipeline.registration.icp import Surface, normal_equations
from worker.pipeline.registration.preprocessing import (
    PreparedScan,
    ScanRejected,
    free_space_violation,
    prepare,
)
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.registration.scan_to_scan import PairResult, coarse_pair, register_pair
from worker.pipeline.registration.settings import RegistrationSettings

_KEPT = 24  # prepared scans in the memory of one process, 3 MB each
_EXTENT_VOXEL = 0.5  # metres; what is kept of a scan to judge its extent
_BEST_ROUGH = 2  # candidates of a pair that are worth a full ICP


@dataclass(frozen=True, kw_only=True, slots=True)
class Folder:
    """Where the prepared scans of one build lie, by index of the file."""

    root: Path

    def path(self, index: int) -> Path:
        """Of one scan."""
        return self.root / f"{index:06d}.npz"

    def load(self, index: int) -> PreparedScan:
        """One scan, from memory if it was asked for lately."""
        return _loaded(self.path(index))


@functools.lru_cache(maxsize=_KEPT)
def _loaded(path: Path) -> PreparedScan:
    return PreparedScan.load(path)


def forget_loaded() -> None:
    """Give back the memory of the scans that were loaded."""
    _loaded.cache_clear()


@dataclass(frozen=True, kw_only=True, slots=True)
class PrepareTask:
    """A file to be read and prepared."""

    folder: Folder
    index: int
    file: ScanFile
    settings: RegistrationSettings
    max_points: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Read:
    """What became of it: an error, or where its points are."""

    index: int
    error: ScanError | None = None  #: the file cannot be read
    reason: str | None = None  #: it can, but holds no pose
    points: Points | None = None  #: (N, 3) metres, scan frame: one a coarse voxel
    sensor_pose: Matrix4 | None = None  #: (4, 4) scan_from_sensor


def read_and_prepare(task: PrepareTask) -> Read:
    """Read a file, prepare it and lay it into the folder."""
    try:
        scan = task.file.read(max_points=task.max_points)
    except ScanError as error:
        return Read(index=task.index, error=error)
    try:
        prepared = prepare(scan, task.settings)
    except ScanRejected as error:
        return Read(index=task.index, reason=str(error))
    prepared.save(task.folder.path(task.index))
    return Read(index=task.index, points=thin(prepared.surface.points), sensor_pose=scan.sensor_pose)


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchTask:
    """One source and the targets it is to be found in, with no start."""

    folder: Folder
    source: int
    targets: tuple[int, ...]
    candidates: int
    settings: RegistrationSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class Found:
    """The best rough poses of one pair, best first; empty where none came near."""

    target: int
    source: int
    poses: tuple[CoarsePose, ...]

    @property
    def score(self) -> float:
        """Of the best, 0..1."""
        return self.poses[0].score if self.poses else 0.0


def search(task: SearchTask) -> list[Found]:
    """Correlate the source's plan with every target's, look at the candidates, and at identity."""
    source = task.folder.load(task.source)
    view = bev_correlation.BevImage.of(source.surface)
    size = bev_correlation.PAIR_SIZE
    turned = bev_correlation.turned_spectra(view, size)
    results = []
    for number in task.targets:
        target = task.folder.load(number)
        other = bev_correlation.BevImage.of(target.surface)
        spectra = bev_correlation.spectrum(other, size)
        matches = bev_correlation.matches(view, turned, other, spectra, count=task.candidates)
        starts = [np.eye(4), *(match.target_from_source for match in matches)]
        rough = [coarse_pair(source, target, start, task.settings) for start in starts]
        best = sorted((each for each in rough if each.score > 0), key=lambda each: -each.score)
        results.append(Found(target=number, source=task.source, poses=tuple(best[:_BEST_ROUGH])))
    return results


@dataclass(frozen=True, kw_only=True, slots=True)
class RegisterTask:
    """One target and the sources to be registered to it: index, prior of target_from_source, or starts."""

    folder: Folder
    target: int
    sources: tuple[tuple[int, Matrix4 | None, tuple[Matrix4, ...]], ...]
    settings: RegistrationSettings


def register_pairs(task: RegisterTask) -> list[PairResult]:
    """ICP of every source to the target."""
    target = task.folder.load(task.target)
    return [
        register_pair(
            (task.target, number),
            task.folder.load(number),
            target,
            prior=prior,
            starts=starts,
            settings=task.settings,
        )
        for number, prior, starts in task.sources
    ]


@dataclass(frozen=True, kw_only=True, slots=True)
class LinearizeTask:
    """One target and the sources near it, at poses map_from_scan that are nearly right."""

    folder: Folder
    target: tuple[int, Matrix4]
    sources: tuple[tuple[int, Matrix4], ...]
    within: float  #: metres, gate of the point pairs
    every: int  #: of the source's points
    glancing: bool  #: whether free space is asked too


@dataclass(frozen=True, kw_only=True, slots=True)
class LinearizedPair:
    """What the points of two scans ask of their poses, and whether free space contradicts them."""

    term: Factor
    num_inliers: int
    square_residual: float  #: square metres, mean
    free_space_violation: float  #: 0..1, the worse direction


def linearise(task: LinearizeTask) -> list[LinearizedPair]:
    """Point-to-plane terms in the map frame."""
    number, target_pose = task.target
    target = task.folder.load(number)
    results = []
    for other, pose in task.sources:
        source = task.folder.load(other)
        found = linearised_pair(
            (number, other),
            source.surface,
            target.surface,
            inverse(target_pose) @ pose,
            within=task.within,
            every=task.every,
            map_from_target=target_pose,
        )
        if task.glancing:
            through = free_space_violation(source, target, inverse(target_pose) @ pose)
            found = replace(found, free_space_violation=through)
        results.append(found)
    return results


def linearised_pair(
    numbers: tuple[int, int],
    source: Surface,
    target: Surface,
    target_from_source: Matrix4,
    *,
    within: float,
    every: int,
    map_from_target: Matrix4 | None = None,
) -> LinearizedPair:
    """The point-to-plane term of target and source; the target's frame is the map's if not told otherwise."""
    equations = normal_equations(
        source, target, target_from_source, within=within, every=every, frame_from_target=map_from_target
    )
    term = Factor(
        target=numbers[0],
        source=numbers[1],
        information=equations.information,
        gradient=equations.gradient,
    )
    return LinearizedPair(
        term=term,
        num_inliers=equations.num_inliers,
        square_residual=equations.square_residual,
        free_space_violation=0.0,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class FreeSpaceTask:
    """One target and the sources near it, at poses map_from_scan: does free space contradict them?"""

    folder: Folder
    target: tuple[int, Matrix4]
    sources: tuple[tuple[int, Matrix4], ...]


def glance(task: FreeSpaceTask) -> list[tuple[int, int, float]]:
    """Target, source, and the share of points that stand where the other saw free space, 0..1."""
    number, target_pose = task.target
    target = task.folder.load(number)
    return [
        (number, other, free_space_violation(task.folder.load(other), target, inverse(target_pose) @ pose))
        for other, pose in task.sources
    ]


def thin(points: Floats) -> Points:
    """(N, 3) metres: one a coarse voxel, enough to judge an extent."""
    return Voxels.of(points, size=_EXTENT_VOXEL).points


def assembled(folder: Folder, poses: Sequence[tuple[int, Matrix4]], *, voxel_size: float) -> Surface:
    """The prepared scans laid together, one point a voxel, with the normals they have: a map in a hurry."""
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    taken = np.empty(0, np.int64)
    for index, pose in poses:
        surface = folder.load(index).surface
        points = surface.points @ pose[:3, :3].T + pose[:3, 3]
        keys = Voxels.keys_of(points, size=voxel_size)
        new = ~np.isin(keys, taken)
        taken = np.concatenate([taken, np.unique(keys[new])])
        parts.append((points[new], surface.normals[new] @ pose[:3, :3].T, surface.oriented[new]))
    points, normals, oriented = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Surface.of(points, normals, oriented)
