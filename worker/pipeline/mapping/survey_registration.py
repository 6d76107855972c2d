"""Survey registration: scans in a map that is there already, of a survey or of what the map is to grow by.

Each is placed in the map by itself; scans whose priors stand in one frame vouch for each other; then all of them are
refined together, against the map and against each other, and what disagrees is left out and named.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import add

import numpy as np

from worker.cloud.poses import difference, inverse
from worker.cloud.sight import Sights
from worker.cloud.types import Matrix4
from worker.errors import ScanError
from worker.pipeline.mapping.multiview_refinement import Refined, refine_jointly, uncertainties
from worker.pipeline.mapping.refusals import explained
from worker.pipeline.mapping.settings import JointRegistrationSettings
from worker.pipeline.mapping.tasks import (
    LinearizedPair,
    PlaceTask,
    PrepareTask,
    ValidScan,
    Workspace,
    downsample,
    lay_together,
    open_workspace,
    place_one,
    read_and_prepare,
)
from worker.pipeline.placement.belief import confidence, log_odds
from worker.pipeline.placement.contradictions import Held, Place
from worker.pipeline.placement.placed_scan import PlacedScan, other_place
from worker.pipeline.placement.scan_placement import CLEAR
from worker.pipeline.registration.diagnosis import Diagnosis, without_doubles
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.icp import normal_equations
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.results import (
    ScanFile,
    ScanRejected,
    ScanResult,
    SurveyPlacement,
)
from worker.pipeline.registration.scan_to_map import registration_result
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import rejected
from worker.processes import default_processes
from worker.progress import Progress, monotonic_progress, no_progress

MAP = -1  #: the map's index among the scans; the lowest, so that it is the target of every pair
_DISTANCE, _EVERY = 0.05, 2  # metres; points: how a scan by itself is weighed
_DISAGREE = 0.05  # metres that the other scans may move a scan from where it was registered
_FEW = 5  # scans up to which processes cost more than they bring
_LIKELY = 0.5  # confidence below which a scan needs another one to vouch for it

Scans = Mapping[int, PreparedScan]  #: by index of the file
Placed = dict[int, PlacedScan]  #: likewise, of the scans that have a place


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyRegistration:
    """What became of each scan, in the order of the files, and how sure the whole is."""

    outcomes: tuple[ScanResult, ...]
    placement: SurveyPlacement
    held: tuple[
        tuple[Held, Held], ...
    ]  #: of accepted scans, their points against the map's and the other way


def register_survey_scans(
    files: Sequence[ScanFile],
    target: Surface,
    *,
    settings: JointRegistrationSettings,
    sights: Sights | None = None,
    growing: bool = False,
    processes: int | None = None,
    progress: Progress = no_progress,
) -> SurveyRegistration:
    """Return an outcome for each file, in their order, map frame, and how sure they are as a whole.

    `sights` is how far the map's scans saw: without them poses are judged by surfaces alone. `growing` looks for what
    found no place also in what the other scans saw, as long as that helps, and takes no scan in doubt. `processes` is
    one a core if None. Raises ScanError where no file can be read.
    """
    count = default_processes() if processes is None else processes
    with open_workspace(settings, processes=count if len(files) > _FEW else 1) as workspace:
        visit = _Visit(
            files=files,
            place=Place(surface=target, sights=sights),
            workspace=workspace,
            progress=monotonic_progress(progress),
            growing=growing,
        )
        return visit.run()


@dataclass(frozen=True, kw_only=True, slots=True)
class _Visit:
    """The scans of one visit: the inputs, each step as a method, and who is left out on the way."""

    files: Sequence[ScanFile]
    place: Place
    workspace: Workspace
    progress: Progress
    growing: bool
    errors: dict[int, Exception] = field(default_factory=dict)  #: why a file is left out, by its index
    oddities: dict[int, tuple[Diagnosis, ...]] = field(
        default_factory=dict
    )  #: what is odd about it by itself

    def run(self) -> SurveyRegistration:
        """Run the steps in order."""
        priors = self._prepare()
        placed = self._place(priors, self.place, MAP)
        self._vouch(placed, priors)
        self._explain(priors)
        if self.growing:
            self._grow(placed, priors)
        self.progress("registering", 1.0)
        refined = self._refine(placed)
        outcomes = tuple(
            self._accepted(index, placed[index], refined)
            if index in refined.poses
            else ScanResult.rejected(file.name, self.errors[index], warnings=self.oddities.get(index, ()))
            for index, file in enumerate(self.files)
        )
        kept = [scan for index, scan in placed.items() if index in refined.poses]
        held = tuple(scan.held for scan in kept if scan.held is not None)
        return SurveyRegistration(outcomes=outcomes, placement=self._whole(kept), held=held)

    def _prepare(self) -> dict[int, Matrix4 | None]:
        """Read every file; return the priors of those that can hold a pose. Raises ScanError where none can be read."""
        tasks = [
            PrepareTask(
                folder=self.workspace.folder,
                index=index,
                file=file,
                settings=self.workspace.settings,
                with_sights=True,
            )
            for index, file in enumerate(self.files)
        ]
        priors: dict[int, Matrix4 | None] = {}
        for index, scan in self.workspace.processes.map_unordered(read_and_prepare, tasks):
            self.progress("registering", 0.0)
            if isinstance(scan, ValidScan):
                priors[index], self.oddities[index] = scan.prior, scan.oddities
            else:
                self.errors[index] = scan
        unreadable = [self.errors[index] for index in sorted(self.errors)]
        if len(unreadable) == len(self.files) and all(isinstance(error, ScanError) for error in unreadable):
            raise unreadable[0]
        return dict(sorted(priors.items()))

    def _place(self, priors: Mapping[int, Matrix4 | None], place: Place, map_index: int) -> Placed:
        """Place each scan in the map by itself, side by side where there are several processes."""
        if priors and self.workspace.processes.count > 1:
            self.workspace.folder.save_map(map_index, place.surface, place.sights)
        tasks = [
            PlaceTask(
                folder=self.workspace.folder,
                map_index=map_index,
                index=index,
                prior=prior,
                settings=self.workspace.settings,
            )
            for index, prior in priors.items()
        ]
        placed: Placed = {}
        for count, (index, found) in enumerate(self._placing(tasks, place), start=1):
            self.progress("registering", count / len(tasks))
            if isinstance(found, PlacedScan):
                placed[index] = found
                self.errors.pop(index, None)
            else:
                self.errors[index] = found
        return dict(sorted(placed.items()))

    def _placing(
        self, tasks: Sequence[PlaceTask], place: Place
    ) -> Iterator[tuple[int, PlacedScan | ScanRejected]]:
        """Run the tasks; in this process every iteration of ICP can be stopped by what reports the progress."""
        if self.workspace.processes.count > 1:
            yield from self.workspace.processes.map_unordered(place_one, tasks)
            return
        for count, task in enumerate(tasks):
            yield task.index, task.run(place, tick=self._tick(count / len(tasks)))

    def _tick(self, share: float) -> Callable[[], None]:
        return lambda: self.progress("registering", share)

    def _vouch(self, placed: Placed, priors: Mapping[int, Matrix4 | None]) -> None:
        """Let scans with a frame in common vouch for each other; leave out those in doubt that none vouches for.

        The priors of one robot share a frame: where most scans stand tells where that lies in the map, and so where
        the others should be looked for.
        """
        expected = {index: self._expected(index, placed, priors) for index in priors}
        again = {
            index: pose
            for index, pose in expected.items()
            if index not in placed and pose is not None and not self._is_near(pose, _known(priors[index]))
        }
        placed |= self._place(again, self.place, MAP)
        for index, scan in list(placed.items()):
            pose = expected[index]
            vouched = pose is not None and self._is_near(scan.pose, pose)
            if self._is_in_doubt(scan, among=len(placed), vouched=vouched):
                self.errors[index] = other_place(self.files[index].name, scan)
                del placed[index]

    def _explain(self, priors: Mapping[int, Matrix4 | None]) -> None:
        """Look for better reasons why scans found no place: mirrored, scaled, moved, a prior kilometres off."""
        better = explained(
            self.errors,
            self.files,
            priors,
            self.place,
            self.workspace,
            map_index=MAP,
            tick=self._tick(1.0),
        )
        self.errors.update(better)

    def _expected(self, index: int, placed: Placed, priors: Mapping[int, Matrix4 | None]) -> Matrix4 | None:
        """Return where the other scans, by their priors, would have this one; None where they do not say."""
        votes: list[tuple[int, float, Matrix4]] = []
        frames = {
            other: scan.pose @ inverse(prior)
            for other, scan in placed.items()
            if other != index and (prior := priors[other]) is not None and scan.log_odds is not None
        }
        for other, frame in frames.items():
            near = sum(self._is_near(placed[third].pose, frame @ _known(priors[third])) for third in frames)
            votes.append((near, placed[other].log_odds or 0.0, frame))
        prior = priors[index]
        if prior is None or not votes:
            return None
        _, _, frame = max(votes, key=lambda vote: vote[:2])
        return frame @ prior

    def _is_near(self, one: Matrix4, other: Matrix4) -> bool:
        settings = self.workspace.settings.registration
        metres, radians = difference(one, other)
        return metres <= settings.prior_distance and radians <= settings.prior_angle

    def _is_in_doubt(self, scan: PlacedScan, *, among: int, vouched: bool) -> bool:
        """Ask most of a scan that a map is to grow by, least of one that others vouch for."""
        if scan.confidence is None:
            return False
        if self.growing:
            return scan.confidence < self.workspace.settings.placement.min_confidence
        return among > 1 and not vouched and scan.confidence < _LIKELY

    def _grow(self, placed: Placed, priors: Mapping[int, Matrix4 | None]) -> None:
        """Place the others in the map together with what has a place in it, as long as that adds to it."""
        voxel_size = self.workspace.settings.registration.voxel_size
        while placed and len(placed) < len(priors):
            self.workspace.folder.save_map(MAP, self.place.surface)
            poses = [(MAP, np.eye(4)), *_poses(placed).items()]
            surface = lay_together(self.workspace.folder, poses, voxel_size=voxel_size)
            grown = Place(surface=surface, sights=self._sights_of(placed))
            missing = {index: prior for index, prior in priors.items() if index not in placed}
            more = self._place(missing, grown, MAP - len(placed))
            for index in [
                index for index, scan in more.items() if self._is_in_doubt(scan, among=1, vouched=False)
            ]:
                self.errors[index] = other_place(self.files[index].name, more.pop(index))
            if not more:
                return
            placed |= more

    def _sights_of(self, placed: Placed) -> Sights | None:
        """Return what the map's scans and those placed in it saw together; None where the map's are not known."""
        if self.place.sights is None:
            return None
        seen = (
            (sights, scan.pose)
            for index, scan in placed.items()
            if (sights := self.workspace.folder.load(index).sights) is not None
        )
        return Sights.joined([self.place.sights, *(sights.placed(pose) for sights, pose in seen)])

    def _refine(self, placed: Placed) -> Refined:
        """Refine all poses together; leave out, worst first, what the others disagree with, and refine again."""
        if len(placed) < 2:
            return self._alone(placed)
        self.workspace.folder.save_map(MAP, self.place.surface)
        poses = _poses(placed)
        points = {index: downsample(self.workspace.folder.load(index).surface.points) for index in poses}
        points[MAP] = downsample(self.place.surface.points)
        while True:
            refined = refine_jointly(
                {MAP: np.eye(4)} | poses,
                points,
                self.workspace,
                fixed=MAP,
                ties=[(MAP, index) for index in poses],
                progress=lambda share: self.progress("refining", share),
            )
            disagreeing = [i for i in poses if self._disagreement(i, placed[i].hypothesis, refined) > 1]
            if not disagreeing or len(poses) == 1:
                return refined
            for index in self._least_believed(disagreeing, placed, refined):
                self.errors[index] = self._disagreeing(index, placed[index].hypothesis, refined)
                del poses[index]
            if not poses:
                return Refined(poses={}, uncertainties={}, free_space_violation={})

    def _least_believed(self, disagreeing: Sequence[int], placed: Placed, refined: Refined) -> list[int]:
        """Return who goes: the least believed where others are clear, else who disagrees most.

        Of the only two scans of a survey, of which nothing tells who is wrong, both go.
        """
        sure = {index: placed[index].confidence for index in disagreeing}
        told = {index: value for index, value in sure.items() if value is not None}
        if told and min(told.values()) < _LIKELY and max(told.values()) >= CLEAR:
            return [min(told, key=lambda index: told[index])]
        if len(placed) == len(told) == 2:
            return list(told)
        return [max(disagreeing, key=lambda i: self._disagreement(i, placed[i].hypothesis, refined))]

    def _alone(self, placed: Placed) -> Refined:
        """Keep the registration of one scan, or of none, to the map; it gives its uncertainty."""
        poses = _poses(placed)
        pairs = []
        for index, pose in poses.items():
            equations = normal_equations(
                self.workspace.folder.load(index).surface,
                self.place.surface,
                pose,
                max_correspondence_distance=_DISTANCE,
                every=_EVERY,
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
        through = refined.free_space_violation[index]
        return rejected(
            self.files[index].name,
            hypothesis,
            "disagrees",
            f"it disagrees with the other scans, which would have it {apart * 100:.0f} cm from where "
            f"it fits the map and see through {through:.1%} of it; scan there again",
            metres=apart,
            seen_through=through,
        )

    def _accepted(self, index: int, placed: PlacedScan, refined: Refined) -> ScanResult:
        origin = self.workspace.folder.load(index).origin
        result = registration_result(placed.hypothesis, origin, pose=refined.poses[index])
        return ScanResult.accepted(
            self.files[index].name,
            replace(result, uncertainty=refined.uncertainties[index]),
            warnings=without_doubles((*placed.warnings, *self.oddities.get(index, ()))),
            confidence=placed.confidence,
        )

    def _whole(self, kept: Sequence[PlacedScan]) -> SurveyPlacement:
        """Judge the survey by what all its scans and the map say of each other."""
        told = [scan.told for scan in kept if scan.told is not None]
        odds = log_odds(functools.reduce(add, told)) if told else None
        if odds is None:
            return SurveyPlacement(confidence=None, in_doubt=False)
        sure = confidence(odds)
        return SurveyPlacement(
            confidence=sure, in_doubt=sure < self.workspace.settings.placement.min_confidence
        )


def _known(prior: Matrix4 | None) -> Matrix4:
    if prior is None:
        raise ValueError("this is asked of scans with a prior alone")
    return prior


def _poses(placed: Placed) -> dict[int, Matrix4]:
    return {index: scan.pose for index, scan in placed.items()}
