"""Scans in a map that is there already: those of a survey, and those that a map is to grow by.

Each is registered to the map by itself; then all of them are refined together, against the map and against each other,
and who disagrees is left out and named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worker.cloud.poses import difference
from worker.cloud.types import Matrix4
from worker.errors import ScanError
from worker.pipeline.mapping.multiview_refinement import Refined, refine_jointly, uncertainties
from worker.pipeline.mapping.settings import MultiScanSettings
from worker.pipeline.mapping.tasks import Folder, assembled, forget_loaded, linearised_pair, thin
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.icp import Surface
from worker.pipeline.registration.preprocessing import PreparedScan, ScanRejected, prepare
from worker.pipeline.registration.results import ScanFile, ScanResult
from worker.pipeline.registration.scan_to_map import placement_of, register
from worker.processes import Processes
from worker.progress import Progress, monotonic_progress, no_progress

MAP = -1  #: the map's number among the scans; the lowest, so that it is the target of every pair
_GATE, _EVERY = 0.05, 2  # metres; points: how a scan by itself is weighed
_DISAGREE = 0.05  # metres that the other scans may move a scan from where it found itself


def register_survey_scans(
    files: Sequence[ScanFile],
    target: Surface,
    *,
    settings: MultiScanSettings,
    growing: bool = False,
    progress: Progress = no_progress,
) -> tuple[ScanResult, ...]:
    """An outcome for each file, in their order, map frame.

    `growing` looks for what found no place also in what the other scans saw, as long as that helps. Raises ScanError
    where no file can be read.
    """
    with TemporaryDirectory(prefix="spicd-scans-") as root:
        try:
            visit = _Visit(
                files=files,
                target=target,
                folder=Folder(root=Path(root)),
                settings=settings,
                progress=monotonic_progress(progress),
            )
            return visit.run(growing=growing)
        finally:
            forget_loaded()


@dataclass(frozen=True, kw_only=True, slots=True)
class _Visit:
    """The scans of one visit, and where they are on their way."""

    files: Sequence[ScanFile]
    target: Surface
    folder: Folder
    settings: MultiScanSettings
    progress: Progress

    def run(self, *, growing: bool) -> tuple[ScanResult, ...]:
        """The whole of it, in order."""
        sound, outcomes = self._read()
        found = self._look(sound, self.target, outcomes)
        while growing and found and len(found) < len(sound):
            missing = {number: scan for number, scan in sound.items() if number not in found}
            more = self._look(missing, self._grown(found), outcomes)
            if not more:
                break
            found |= more
        self.progress("registering", 1.0)
        if not found:
            return tuple(outcomes[number] for number in range(len(self.files)))
        refined, left_out = self._jointly(found, sound)
        for number, best in found.items():
            outcomes[number] = left_out.get(number) or self._outcome(number, best, sound[number], refined)
        return tuple(outcomes[number] for number in range(len(self.files)))

    def _read(self) -> tuple[dict[int, PreparedScan], dict[int, ScanResult]]:
        sound, outcomes, errors = {}, {}, []
        for number, file in enumerate(self.files):
            self.progress("registering", 0.0)
            try:
                scan = file.read(max_points=self.settings.max_points)
                sound[number] = prepare(scan, self.settings.registration)
                if len(self.files) > 1:  # what is refined together is read from the folder
                    sound[number].save(self.folder.path(number))
            except ScanError as error:
                errors.append(error)
                outcomes[number] = ScanResult(name=file.name, placement=None, reason=str(error))
            except ScanRejected as error:
                outcomes[number] = ScanResult(name=file.name, placement=None, reason=str(error))
        if len(errors) == len(self.files):
            raise errors[0]
        return sound, outcomes

    def _look(
        self, scans: Mapping[int, PreparedScan], target: Surface, outcomes: dict[int, ScanResult]
    ) -> dict[int, Hypothesis]:
        """Who finds a place in the target; the others' reasons go to the outcomes."""
        found = {}
        for done, (number, scan) in enumerate(scans.items()):
            try:
                found[number] = register(
                    scan,
                    target,
                    start=self.files[number].start(scan.sensor_pose),
                    settings=self.settings.registration,
                    tick=self._tick(done / len(scans)),
                )
            except ScanRejected as error:
                outcomes[number] = ScanResult(
                    name=self.files[number].name,
                    placement=None,
                    reason=str(error),
                    fitness=error.fitness,
                    inlier_rmse=error.inlier_rmse,
                )
        return found

    def _tick(self, share: float) -> Callable[[], None]:
        return lambda: self.progress("registering", share)

    def _grown(self, found: Mapping[int, Hypothesis]) -> Surface:
        """The map with what was placed on it."""
        self._save_map()
        poses: list[tuple[int, Matrix4]] = [(MAP, np.eye(4))]
        poses += [(number, best.found.target_from_source) for number, best in found.items()]
        return assembled(self.folder, poses, voxel_size=self.settings.registration.voxel_size)

    def _jointly(
        self, found: Mapping[int, Hypothesis], sound: Mapping[int, PreparedScan]
    ) -> tuple[Refined, dict[int, ScanResult]]:
        """Poses refined together, and who was left out because the others disagree."""
        poses = {number: best.found.target_from_source for number, best in found.items()}
        if len(poses) == 1:
            return self._alone(poses, sound), {}
        self._save_map()
        thinned = {number: thin(sound[number].surface.points) for number in poses}
        thinned[MAP] = thin(self.target.points)
        left_out: dict[int, ScanResult] = {}
        while True:
            refined = refine_jointly(
                {MAP: np.eye(4)} | poses,
                thinned,
                fixed=MAP,
                also=[(MAP, number) for number in poses],
                folder=self.folder,
                processes=Processes(None),
                settings=self.settings.mapping,
                progress=lambda share: self.progress("refining", share),
            )
            odd = self._odd_one_out(found, refined)
            if odd is None or len(poses) == 1:
                return refined, left_out
            left_out[odd] = self._disagreeing(odd, found[odd], refined)
            del poses[odd]

    def _odd_one_out(self, found: Mapping[int, Hypothesis], refined: Refined) -> int | None:
        """The scan that disagrees most with the others: by free space, or by where they would have it."""

        def excess(number: int) -> float:
            apart, _ = difference(found[number].found.target_from_source, refined.poses[number])
            limit = self.settings.registration.max_free_space_violation_near_prior
            return max(refined.free_space_violation[number] / limit, apart / _DISAGREE)

        worst = max((number for number in refined.poses if number != MAP), key=excess)
        return worst if excess(worst) > 1 else None

    def _disagreeing(self, number: int, best: Hypothesis, refined: Refined) -> ScanResult:
        apart, _ = difference(best.found.target_from_source, refined.poses[number])
        name = self.files[number].name
        return ScanResult(
            name=name,
            placement=None,
            reason=(
                f"scan {name}: it disagrees with the other scans, which would have it {apart * 100:.0f} cm from where "
                f"it fits the map and see through {refined.free_space_violation[number]:.1%} of it; scan there again"
            ),
            fitness=best.found.fitness,
            inlier_rmse=best.found.inlier_rmse,
        )

    def _alone(self, poses: Mapping[int, Matrix4], sound: Mapping[int, PreparedScan]) -> Refined:
        """One scan: its registration to the map stands, and tells its uncertainty."""
        ((number, pose),) = poses.items()
        term = linearised_pair(
            (MAP, number), sound[number].surface, self.target, pose, within=_GATE, every=_EVERY
        )
        sure = uncertainties({MAP: np.eye(4), number: pose}, [term], fixed=MAP)
        return Refined(poses=dict(poses), uncertainties=sure, free_space_violation={number: 0.0})

    def _outcome(self, number: int, best: Hypothesis, scan: PreparedScan, refined: Refined) -> ScanResult:
        placement = placement_of(best, scan.origin, pose=refined.poses[number])
        return ScanResult(
            name=self.files[number].name,
            placement=replace(placement, uncertainty=refined.uncertainties[number]),
            fitness=best.found.fitness,
            inlier_rmse=best.found.inlier_rmse,
        )

    def _save_map(self) -> None:
        PreparedScan(name="map", surface=self.target, image=None, sensor_pose=np.eye(4)).save(
            self.folder.path(MAP)
        )
