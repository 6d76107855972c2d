"""Survey registration: scans in a map that is there already, of a survey or of what the map is to grow by.

Each is registered to the map by itself; then all of them are refined together, against the map and against each other,
and what disagrees is left out and named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from worker.cloud.poses import difference
from worker.cloud.types import Matrix4
from worker.errors import ScanError
from worker.pipeline.mapping.multiview_refinement import Refined, refine_jointly, uncertainties
from worker.pipeline.mapping.settings import JointRegistrationSettings
from worker.pipeline.mapping.tasks import (
    LinearizedPair,
    Workspace,
    downsample,
    lay_together,
    open_workspace,
)
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.icp import normal_equations
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.results import RegistrationResult, ScanFile, ScanRejected, ScanResult
from worker.pipeline.registration.scan_to_map import register, registration_result
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import rejected
from worker.progress import Progress, monotonic_progress, no_progress

MAP = -1  #: the map's index among the scans; the lowest, so that it is the target of every pair
_DISTANCE, _EVERY = 0.05, 2  # metres; points: how a scan by itself is weighed
_DISAGREE = 0.05  # metres that the other scans may move a scan from where it was registered

Scans = Mapping[int, PreparedScan]  #: by index of the file
Hypotheses = dict[int, Hypothesis]  #: likewise, of the scans that have a place


def register_survey_scans(
    files: Sequence[ScanFile],
    target: Surface,
    *,
    settings: JointRegistrationSettings,
    growing: bool = False,
    progress: Progress = no_progress,
) -> tuple[ScanResult, ...]:
    """Return an outcome for each file, in their order, map frame.

    `growing` looks for what found no place also in what the other scans saw, as long as that helps. Raises ScanError
    where no file can be read.
    """
    with open_workspace(settings) as workspace:
        visit = _Visit(files=files, target=target, workspace=workspace, progress=monotonic_progress(progress))
        return visit.run(growing=growing)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Visit:
    """The scans of one visit: the inputs, each step as a method, and who is left out on the way."""

    files: Sequence[ScanFile]
    target: Surface
    workspace: Workspace
    progress: Progress
    errors: dict[int, Exception] = field(default_factory=dict)  #: why a file is left out, by its index

    def run(self, *, growing: bool) -> tuple[ScanResult, ...]:
        """Run the steps in order."""
        scans = self._prepare()
        hypotheses = self._register(scans, self.target)
        if growing:
            self._grow(scans, hypotheses)
        self.progress("registering", 1.0)
        refined = self._refine(scans, hypotheses)
        return tuple(
            ScanResult.accepted(file.name, self._result(index, scans[index], hypotheses[index], refined))
            if index in refined.poses
            else ScanResult.rejected(file.name, self.errors[index])
            for index, file in enumerate(self.files)
        )

    def _prepare(self) -> dict[int, PreparedScan]:
        """Read every file; raises ScanError where none can be read."""
        scans, settings = {}, self.workspace.settings
        for index, file in enumerate(self.files):
            self.progress("registering", 0.0)
            try:
                scan = file.read(max_points=settings.max_points)
                scans[index] = prepare(scan, settings.registration)
            except (ScanError, ScanRejected) as error:
                self.errors[index] = error
                continue
            if len(self.files) > 1:  # what is refined together is read from the folder
                scans[index].save(self.workspace.folder.path(index))
        unreadable = [error for error in self.errors.values() if isinstance(error, ScanError)]
        if len(unreadable) == len(self.files):
            raise unreadable[0]
        return scans

    def _register(self, scans: Scans, target: Surface) -> Hypotheses:
        """Register each scan to the target by itself."""
        hypotheses = {}
        for count, (index, scan) in enumerate(scans.items()):
            try:
                hypotheses[index] = register(
                    scan,
                    target,
                    prior=self.files[index].prior(scan.sensor_pose),
                    settings=self.workspace.settings.registration,
                    tick=self._tick(count / len(scans)),
                )
            except ScanRejected as error:
                self.errors[index] = error
        return hypotheses

    def _tick(self, share: float) -> Callable[[], None]:
        return lambda: self.progress("registering", share)

    def _grow(self, scans: Scans, hypotheses: Hypotheses) -> None:
        """Register the others to the map together with what has a place on it, as long as that adds to it."""
        voxel_size = self.workspace.settings.registration.voxel_size
        while hypotheses and len(hypotheses) < len(scans):
            self.workspace.folder.save_map(MAP, self.target)
            poses = [(MAP, np.eye(4)), *_poses(hypotheses).items()]
            grown = lay_together(self.workspace.folder, poses, voxel_size=voxel_size)
            missing = {index: scan for index, scan in scans.items() if index not in hypotheses}
            more = self._register(missing, grown)
            if not more:
                return
            hypotheses |= more

    def _refine(self, scans: Scans, hypotheses: Hypotheses) -> Refined:
        """Refine all poses together; leave out, worst first, what the others disagree with, and refine again."""
        if len(hypotheses) < 2:
            return self._alone(scans, hypotheses)
        self.workspace.folder.save_map(MAP, self.target)
        poses = _poses(hypotheses)
        points = {index: downsample(scans[index].surface.points) for index in poses}
        points[MAP] = downsample(self.target.points)
        while True:
            refined = refine_jointly(
                {MAP: np.eye(4)} | poses,
                points,
                self.workspace,
                fixed=MAP,
                ties=[(MAP, index) for index in poses],
                progress=lambda share: self.progress("refining", share),
            )
            worst = max(poses, key=lambda index: self._disagreement(index, hypotheses[index], refined))
            if self._disagreement(worst, hypotheses[worst], refined) <= 1 or len(poses) == 1:
                return refined
            self.errors[worst] = self._disagreeing(worst, hypotheses[worst], refined)
            del poses[worst]

    def _alone(self, scans: Scans, hypotheses: Hypotheses) -> Refined:
        """Keep the registration of one scan, or of none, to the map; it gives its uncertainty."""
        poses = _poses(hypotheses)
        pairs = []
        for index, pose in poses.items():
            surface = scans[index].surface
            equations = normal_equations(
                surface, self.target, pose, max_correspondence_distance=_DISTANCE, every=_EVERY
            )
            pairs.append(LinearizedPair(target=MAP, source=index, equations=equations))
        sigmas = uncertainties({MAP: np.eye(4)} | poses, pairs, fixed=MAP)
        return Refined(poses=poses, uncertainties=sigmas, free_space_violation=dict.fromkeys(poses, 0.0))

    def _disagreement(self, index: int, hypothesis: Hypothesis, refined: Refined) -> float:
        """Measure how far others contradict a scan, by free space or by where they would have it; 1 is the limit."""
        apart, _ = difference(hypothesis.target_from_source, refined.poses[index])
        limit = self.workspace.settings.registration.max_free_space_violation_near_prior
        return max(refined.free_space_violation[index] / limit, apart / _DISAGREE)

    def _disagreeing(self, index: int, hypothesis: Hypothesis, refined: Refined) -> ScanRejected:
        apart, _ = difference(hypothesis.target_from_source, refined.poses[index])
        return rejected(
            self.files[index].name,
            hypothesis,
            "disagrees",
            f"it disagrees with the other scans, which would have it {apart * 100:.0f} cm from where "
            f"it fits the map and see through {refined.free_space_violation[index]:.1%} of it; scan there again",
        )

    def _result(
        self, index: int, scan: PreparedScan, hypothesis: Hypothesis, refined: Refined
    ) -> RegistrationResult:
        result = registration_result(hypothesis, scan.origin, pose=refined.poses[index])
        return replace(result, uncertainty=refined.uncertainties[index])


def _poses(hypotheses: Hypotheses) -> dict[int, Matrix4]:
    return {index: hypothesis.target_from_source for index, hypothesis in hypotheses.items()}
