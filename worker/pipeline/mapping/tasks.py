"""What the processes of a map build do: one function a kind of task, each on scans that lie prepared in a folder."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worker.cloud.poses import inverse, transformed
from worker.cloud.sight import Sights
from worker.cloud.types import Floats, Matrix4, Points
from worker.cloud.voxels import Voxels
from worker.errors import ScanError
from worker.pipeline.mapping.settings import JointRegistrationSettings
from worker.pipeline.placement.contradictions import Place
from worker.pipeline.placement.explanations import Refused, diagnose
from worker.pipeline.placement.placed_scan import PlacedScan
from worker.pipeline.placement.scan_placement import believed_by, place_scan
from worker.pipeline.registration import bev_correlation
from worker.pipeline.registration.diagnosis import Diagnosis
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.icp import NormalEquations, normal_equations
from worker.pipeline.registration.oddities import oddities
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.refinement import CoarsePose, by_score
from worker.pipeline.registration.results import ScanFile, ScanRejected
from worker.pipeline.registration.scan_to_scan import PairResult, coarse_pair, register_pair
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import free_space_violation
from worker.processes import Processes, open_processes

_KEPT = 24  # prepared scans in the memory of one process, 3 MB each
_EXTENT_VOXEL = 0.5  # metres; what is kept of a scan to judge its extent
_BEST_COARSE = 2  # candidates of a pair that are worth a full ICP


@dataclass(frozen=True, kw_only=True, slots=True)
class Folder:
    """Where the prepared scans of one build lie, by index of the file."""

    root: Path

    def path(self, index: int) -> Path:
        """Return the path of one scan."""
        return self.root / f"{index:06d}.npz"

    def load(self, index: int) -> PreparedScan:
        """Load one scan, from memory if it was asked for lately."""
        return _loaded(self.path(index))

    def save_map(self, index: int, surface: Surface, sights: Sights | None = None) -> None:
        """Lay a map beside the scans, as if it were one of them."""
        scan = PreparedScan(name="map", surface=surface, image=None, sensor_pose=np.eye(4), sights=sights)
        scan.save(self.path(index))


@functools.lru_cache(maxsize=_KEPT)
def _loaded(path: Path) -> PreparedScan:
    return PreparedScan.load(path)


def forget_loaded() -> None:
    """Give back the memory of the scans that were loaded."""
    _loaded.cache_clear()


@dataclass(frozen=True, kw_only=True, slots=True)
class Workspace:
    """What all stages of one build share."""

    folder: Folder
    processes: Processes
    settings: JointRegistrationSettings


@contextmanager
def open_workspace(settings: JointRegistrationSettings, *, processes: int = 1) -> Iterator[Workspace]:
    """Make a folder and start the processes; both go at the end, and what was loaded is forgotten."""
    with TemporaryDirectory(prefix="spicd-scans-") as root, open_processes(processes) as pool:
        try:
            yield Workspace(folder=Folder(root=Path(root)), processes=pool, settings=settings)
        finally:
            forget_loaded()


@dataclass(frozen=True, kw_only=True, slots=True)
class ValidScan:
    """A scan that was read and can hold a pose; its prepared points lie in the folder."""

    points: Points  #: (N, 3) metres, scan frame, downsampled: for its extent
    prior: Matrix4 | None  #: map_from_scan as the robot believes it
    oddities: tuple[Diagnosis, ...] = ()  #: what is odd about it by itself


@dataclass(frozen=True, kw_only=True, slots=True)
class PrepareTask:
    """A file to be read and prepared."""

    folder: Folder
    index: int  #: of the file
    file: ScanFile
    settings: JointRegistrationSettings
    with_sights: bool = False  #: to judge poses by what it saw


def read_and_prepare(task: PrepareTask) -> tuple[int, ValidScan | ScanError | ScanRejected]:
    """Read a file, prepare it and lay it into the folder; return its index, and why it is not valid if it is not."""
    try:
        scan = task.file.read(max_points=task.settings.max_points)
        prepared = prepare(scan, task.settings.registration, with_sights=task.with_sights)
    except (ScanError, ScanRejected) as error:
        return task.index, error
    prepared.save(task.folder.path(task.index))
    prior = task.file.prior(scan.sensor_pose, own=scan.prior, offset=scan.offset)
    voxel_size = task.settings.registration.voxel_size
    return task.index, ValidScan(
        points=downsample(prepared.surface.points),
        prior=prior,
        oddities=oddities(scan, prepared, prior=prior, voxel_size=voxel_size),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaceTask:
    """One scan to be placed in a map that lies beside it."""

    folder: Folder
    map_index: int
    index: int
    prior: Matrix4 | None  #: map_from_scan
    settings: JointRegistrationSettings

    def run(self, place: Place, *, tick: Callable[[], None] = lambda: None) -> PlacedScan | ScanRejected:
        """Return the scan's place in the map, or why it has none."""
        try:
            return place_scan(
                self.folder.load(self.index),
                place,
                prior=self.prior,
                registration=self.settings.registration,
                placement=self.settings.placement,
                tick=tick,
            )
        except ScanRejected as error:
            return error


def place_one(task: PlaceTask) -> tuple[int, PlacedScan | ScanRejected]:
    """Place a scan in the map that lies beside it; return its index with the result."""
    return task.index, task.run(_place_of(task.folder, task.map_index))


@dataclass(frozen=True, kw_only=True, slots=True)
class ExplainTask:
    """One scan that found no place, to find out why."""

    folder: Folder
    map_index: int
    index: int
    file: ScanFile
    hypotheses: tuple[Hypothesis, ...]
    settings: JointRegistrationSettings

    def run(self, place: Place, *, tick: Callable[[], None] = lambda: None) -> Diagnosis | None:
        """Return the explanation that holds; None where none does. The file is read again, for the order of points."""
        settings = self.settings
        prepared = self.folder.load(self.index) if self.hypotheses else None
        case = Refused(
            scan=self.file.read(max_points=settings.max_points),
            prepared=prepared,
            hypotheses=self.hypotheses,
            target=place.surface,
            settings=settings.registration,
            prepare=functools.partial(prepare, settings=settings.registration, with_sights=True),
            believed=believed_by(place),
            max_searches=settings.placement.max_searches if self.hypotheses else 0,
            tick=tick,
        )
        return diagnose(case)


def explain_one(task: ExplainTask) -> tuple[int, Diagnosis | None]:
    """Explain why a scan has no place in the map that lies beside it; return its index with the explanation."""
    return task.index, task.run(_place_of(task.folder, task.map_index))


@functools.lru_cache(maxsize=2)
def _place_of(folder: Folder, map_index: int) -> Place:
    laid = folder.load(map_index)
    return Place(surface=laid.surface, sights=laid.sights)


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchTask:
    """One source and the targets it is to be found in, with no start."""

    folder: Folder
    source: int
    targets: tuple[int, ...]
    candidates: int  #: of the BEV correlation, for each target
    settings: RegistrationSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchResult:
    """The best coarse poses of one pair, best first; empty where none came near."""

    target: int
    source: int
    poses: tuple[CoarsePose, ...]

    @property
    def score(self) -> float:
        """Of the best, 0..1."""
        return self.poses[0].score if self.poses else 0.0


def search(task: SearchTask) -> list[SearchResult]:
    """Correlate the source's BEV image with every target's, and align the candidates and identity coarsely."""
    source = task.folder.load(task.source)
    image = bev_correlation.BevImage.of(source.surface)
    size = bev_correlation.PAIR_SIZE
    rotated = bev_correlation.rotated_spectra(image, size)
    results = []
    for index in task.targets:
        target = task.folder.load(index)
        other = bev_correlation.BevImage.of(target.surface)
        spectra = bev_correlation.spectrum(other, size)
        matches = bev_correlation.correlate(image, rotated, other, spectra, count=task.candidates)
        starts = [np.eye(4), *(match.target_from_source for match in matches)]
        best = by_score(coarse_pair(source, target, start, task.settings) for start in starts)
        poses = tuple(pose for pose in best if pose.score > 0)[:_BEST_COARSE]
        results.append(SearchResult(target=index, source=task.source, poses=poses))
    return results


@dataclass(frozen=True, kw_only=True, slots=True)
class RegisterTask:
    """One target and the sources to be registered to it: index, prior of target_from_source, or starts."""

    folder: Folder
    target: int
    sources: tuple[tuple[int, Matrix4 | None, tuple[Matrix4, ...]], ...]
    settings: RegistrationSettings


def register_pairs(task: RegisterTask) -> list[PairResult]:
    """Register every source to the target."""
    target = task.folder.load(task.target)
    return [
        register_pair(
            (task.target, index),
            task.folder.load(index),
            target,
            prior=prior,
            starts=starts,
            settings=task.settings,
        )
        for index, prior, starts in task.sources
    ]


@dataclass(frozen=True, kw_only=True, slots=True)
class LinearizeTask:
    """One target and the sources near it, at poses map_from_scan that are nearly right."""

    folder: Folder
    target: tuple[int, Matrix4]
    sources: tuple[tuple[int, Matrix4], ...]
    max_correspondence_distance: float  #: metres
    every: int  #: of the source's points
    check_free_space: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class LinearizedPair:
    """What the points of two scans ask of their poses, and whether free space contradicts them."""

    target: int
    source: int
    equations: NormalEquations  #: point to plane, map frame
    free_space_violation: float = 0.0  #: 0..1, the worse direction; 0 where it was not asked


def linearize(task: LinearizeTask) -> list[LinearizedPair]:
    """Return the point-to-plane equations of each source with the target, in the map frame."""
    target_index, map_from_target = task.target
    target = task.folder.load(target_index)
    results = []
    for index, map_from_source in task.sources:
        source = task.folder.load(index)
        target_from_source = inverse(map_from_target) @ map_from_source
        equations = normal_equations(
            source.surface,
            target.surface,
            target_from_source,
            max_correspondence_distance=task.max_correspondence_distance,
            every=task.every,
            frame_from_target=map_from_target,
        )
        violation = free_space_violation(source, target, target_from_source) if task.check_free_space else 0.0
        results.append(
            LinearizedPair(
                target=target_index, source=index, equations=equations, free_space_violation=violation
            )
        )
    return results


@dataclass(frozen=True, kw_only=True, slots=True)
class FreeSpaceTask:
    """One target and the sources near it, at poses map_from_scan: does free space contradict them?"""

    folder: Folder
    target: tuple[int, Matrix4]
    sources: tuple[tuple[int, Matrix4], ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Violation:
    """Two scans of which one stands in what the other saw as free."""

    target: int
    source: int
    share: float  #: of points, the worse direction, 0..1


def check_free_space(task: FreeSpaceTask) -> list[Violation]:
    """Return for each source the share of points that stand where the other scan saw free space."""
    target_index, map_from_target = task.target
    target = task.folder.load(target_index)
    return [
        Violation(
            target=target_index,
            source=index,
            share=free_space_violation(
                task.folder.load(index), target, inverse(map_from_target) @ map_from_source
            ),
        )
        for index, map_from_source in task.sources
    ]


def downsample(points: Floats) -> Points:
    """Return one of the points (N, 3), metres, a coarse voxel: enough to judge an extent."""
    return Voxels.of(points, size=_EXTENT_VOXEL).points


def lay_together(folder: Folder, poses: Sequence[tuple[int, Matrix4]], *, voxel_size: float) -> Surface:
    """Lay prepared scans together, one point a voxel, with the normals they have: a map without fusing."""
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    taken = np.empty(0, np.int64)
    for index, pose in poses:
        surface = folder.load(index).surface
        points = transformed(surface.points, pose)
        keys = Voxels.keys_of(points, size=voxel_size)
        new = ~np.isin(keys, taken)
        taken = np.concatenate([taken, np.unique(keys[new])])
        parts.append((points[new], surface.normals[new] @ pose[:3, :3].T, surface.oriented[new]))
    points, normals, oriented = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Surface.of(points, normals, oriented)
