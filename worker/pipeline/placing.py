"""Placing: many scans in one frame (Stage 1; paper, Section 3.3.2).

Overlap culling, pairwise ICP in parallel processes, pose graph, largest component, shortest paths, joint refinement;
then what was left out is looked for in the map that now exists.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from worker.errors import MapFailed
from worker.pipeline.frame import map_from_reference
from worker.pipeline.free_space_vote import contradictions, most_accused
from worker.pipeline.map_settings import MapSettings
from worker.pipeline.pair_memory import Forgetful, PairMemory
from worker.pipeline.pair_work import Folder, Read, Reading, forget_loaded, read_and_prepare
from worker.pipeline.pairing import PairWork, Sound, plan_pairs, register_planned
from worker.pipeline.pairwise import PairResult
from worker.pipeline.placement import ScanFile
from worker.pipeline.placing_result import Placed, Result
from worker.pipeline.placing_settings import PlacingSettings
from worker.pipeline.pose_graph import components
from worker.pipeline.refinement import Refined, refine_jointly
from worker.pipeline.registration_settings import RegistrationSettings
from worker.pipeline.rescue import Rescued, rescue
from worker.pipeline.solution import Solution, solve_graph
from worker.pipeline.values import Matrix4
from worker.processes import default_processes, open_processes
from worker.progress import Progress, rising, silent

_FEW = 4  # scans up to which processes cost more than they bring


def place_together(
    files: Sequence[ScanFile],
    *,
    settings: PlacingSettings,
    memory: PairMemory | None = None,
    processes: int | None = None,
    progress: Progress = silent,
) -> Placed:
    """Find a pose for every scan that has one among the others; name the rest with a reason.

    `processes` is one a core if None. Raises MapFailed where no scan can hold a pose, and ScanError where none can
    be read.
    """
    count = default_processes() if processes is None else processes
    with TemporaryDirectory(prefix="spicd-scans-") as root, open_processes(_worth(count, files)) as pool:
        try:
            build = _Build(
                files=files,
                registration=settings.registration,
                mapping=settings.mapping,
                max_points=settings.max_points,
                work=PairWork(
                    folder=Folder(root=Path(root)),
                    processes=pool,
                    registration=settings.registration,
                    mapping=settings.mapping,
                    memory=Forgetful() if memory is None else memory,
                ),
                progress=rising(progress),
            )
            return build.run()
        finally:
            forget_loaded()


def _worth(count: int, files: Sequence[ScanFile]) -> int:
    return 1 if len(files) <= _FEW else count


@dataclass(frozen=True, kw_only=True, slots=True)
class _Build:
    """One build: its inputs, and each stage as a method."""

    files: Sequence[ScanFile]
    registration: RegistrationSettings
    mapping: MapSettings
    max_points: int
    work: PairWork
    progress: Progress

    def run(self) -> Placed:
        """The whole of it, in order."""
        read = self._read()
        sound = self._sound(read)
        pairs, solution = self._connected(sound)
        self.progress("registering", 1.0)
        self.progress("refining", 0.0)
        tied = [(edge.target, edge.source) for edge in solution.kept]
        refined = self._refined(solution, solution.poses, sound, also=tied, first=True)
        rescued: dict[int, Rescued] = {}
        while missing := sorted(set(sound) - set(refined.poses)):
            tried = rescue(missing, refined.poses, solution.reference, sound, self.work)
            found = {number: each.pose for number, each in tried.items() if each.pose is not None}
            rescued |= tried
            if not found:
                break
            before = len(refined.poses)
            tied += [(rescued[number].beside, number) for number in found]
            refined = self._refined(solution, refined.poses | found, sound, also=tied, first=False)
            if len(refined.poses) <= before:  # who was found is contradicted by the others
                break
        self.progress("refining", 1.0)
        priors = {number: scan.prior for number, scan in sound.items() if scan.prior is not None}
        result = Result(
            read=read,
            pairs=pairs,
            solution=solution,
            refined=refined,
            rescued=rescued,
            frame=map_from_reference(refined.poses, priors, solution.reference),
        )
        return result.placed(self.files, self.work.folder)

    def _read(self) -> dict[int, Read]:
        tasks = [
            Reading(
                folder=self.work.folder,
                index=index,
                file=file,
                settings=self.registration,
                max_points=self.max_points,
            )
            for index, file in enumerate(self.files)
        ]
        read = {}
        for done, each in enumerate(self.work.processes.each(read_and_prepare, tasks)):
            read[each.index] = each
            self.progress("reading", done / len(tasks))
        self.progress("reading", 1.0)
        return read

    def _sound(self, read: Mapping[int, Read]) -> dict[int, Sound]:
        """The scans that can hold a pose; raises where there is none."""
        sound = {}
        for index, each in sorted(read.items()):
            if each.points is not None and each.sensor_pose is not None:
                sound[index] = Sound(points=each.points, prior=self.files[index].start(each.sensor_pose))
        if sound:
            return sound
        errors = [read[index].error for index in sorted(read) if read[index].error]
        if len(errors) == len(read) and errors[0] is not None:
            raise errors[0]
        raise MapFailed("; ".join(str(each.error or each.reason) for _, each in sorted(read.items())))

    def _connected(self, sound: Mapping[int, Sound]) -> tuple[list[PairResult], Solution]:
        """Register the likeliest pairs; as long as that leaves several parts, the likeliest between them as well."""
        searching = any(scan.prior is None for scan in sound.values())
        half = 0.5 if searching else 0.0
        span = (1 - half) / self.mapping.pairing_rounds
        plan = plan_pairs(sound, self.work, progress=self._part(0.0, half))
        wanted, pairs = plan.first(self.mapping), []
        for round_ in range(self.mapping.pairing_rounds):
            begin = half + span * round_
            pairs += register_planned(wanted, plan, sound, self.work, progress=self._part(begin, span))
            solution = self._solved(plan.numbers, pairs, sound)
            parts = components(plan.numbers, [*solution.kept, *solution.elsewhere])
            wanted = plan.across(parts, {(pair.target, pair.source) for pair in pairs}, self.mapping)
            if not wanted:
                break
        return pairs, solution

    def _solved(
        self, numbers: Sequence[int], pairs: Sequence[PairResult], sound: Mapping[int, Sound]
    ) -> Solution:
        """The graph solved without the edges that free space accuses, one after the other."""
        points = {number: sound[number].points for number in numbers}
        accused: list[PairResult] = []
        while True:
            heard = [pair for pair in pairs if not any(pair is each for each in accused)]
            solution = solve_graph(numbers, heard, self.mapping)
            found = contradictions(
                solution.poses,
                points,
                self.work.folder,
                self.work.processes,
                limit=self.mapping.max_contradiction,
                settings=self.mapping,
            )
            worst = most_accused(list(solution.poses), solution.kept, found, self.mapping)
            if worst is None:
                return replace(solution, contradicted=(*solution.contradicted, *accused))
            accused.append(worst)

    def _part(self, begin: float, span: float) -> Callable[[float], None]:
        """Progress of a part of the registration."""
        return lambda share: self.progress("registering", begin + span * share)

    def _refined(
        self,
        solution: Solution,
        poses: Mapping[int, Matrix4],
        sound: Mapping[int, Sound],
        *,
        also: Sequence[tuple[int, int]],
        first: bool,
    ) -> Refined:
        """Refine jointly; leave out, worst first, whom the free space of the others contradicts, and refine again."""
        current = dict(poses)
        while True:
            refined = refine_jointly(
                current,
                {number: sound[number].points for number in current},
                fixed=solution.reference,
                also=also,
                folder=self.work.folder,
                processes=self.work.processes,
                settings=self.mapping,
                progress=lambda share: self.progress("refining", (0.6 if first else 0.9) * share),
            )
            worst = max(refined.seen_through, key=lambda number: refined.seen_through[number])
            if (
                refined.seen_through[worst] <= self.registration.max_seen_through
                or worst == solution.reference
            ):
                return refined
            current = {number: pose for number, pose in refined.poses.items() if number != worst}
