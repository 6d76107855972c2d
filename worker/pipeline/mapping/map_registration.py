"""What came of placing: an outcome for every file, and the totals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worker.cloud.poses import transformed
from worker.cloud.types import Matrix4
from worker.errors import MapFailed
from worker.pipeline.mapping.frame import map_from_reference
from worker.pipeline.mapping.multiview_refinement import Refined, refine_jointly
from worker.pipeline.mapping.outlier_rejection import contradictions, most_accused
from worker.pipeline.mapping.pair_registration import (
    NullPairCache,
    PairCache,
    PairWork,
    ValidScan,
    plan_pairs,
    register_planned,
)
from worker.pipeline.mapping.pose_graph import Solution, components, solve_graph
from worker.pipeline.mapping.relocalization import Relocalized, relocalize
from worker.pipeline.mapping.report import MapReport
from worker.pipeline.mapping.settings import MapSettings, MultiScanSettings
from worker.pipeline.mapping.tasks import Folder, PrepareTask, Read, forget_loaded, read_and_prepare
from worker.pipeline.registration.results import RegistrationResult, ScanFile, ScanResult
from worker.pipeline.registration.scan_to_scan import PairResult
from worker.pipeline.registration.settings import RegistrationSettings
from worker.processes import default_processes, open_processes
from worker.progress import Progress, monotonic_progress, no_progress


@dataclass(frozen=True, kw_only=True, slots=True)
class MapRegistration:
    """Every scan's outcome, in the order of the files, and how it came about."""

    outcomes: tuple[ScanResult, ...]
    report: MapReport
    kept: tuple[PairResult, ...]  #: the registrations that the map rests on
    contradicted: tuple[PairResult, ...]  #: accepted ones that were thrown out


@dataclass(frozen=True, kw_only=True, slots=True)
class Result:
    """What the stages left, by index of the file."""

    read: Mapping[int, Read]
    pairs: Sequence[PairResult]  #: all that were tried
    solution: Solution
    refined: Refined
    relocalized: Mapping[int, Relocalized]
    frame: Matrix4  #: (4, 4) map from the reference scan's frame

    def placed(self, files: Sequence[ScanFile], folder: Folder) -> MapRegistration:
        """Put together; the sensors' places come from the prepared scans in the folder."""
        poses = self.refined.poses
        kept = tuple(edge for edge in self.solution.kept if edge.target in poses and edge.source in poses)
        by_scan = _by_scan(kept)
        outcomes = tuple(
            self._accepted(index, file.name, by_scan[index], folder)
            if index in poses
            else self._left_out(index, file.name)
            for index, file in enumerate(files)
        )
        report = MapReport.of(
            scans=len(files),
            accepted=len(poses),
            pairs=self.pairs,
            kept=kept,
            reference=self.solution.reference,
        )
        return MapRegistration(
            outcomes=outcomes, report=report, kept=kept, contradicted=self.solution.contradicted
        )

    def _accepted(self, index: int, name: str, edges: Sequence[PairResult], folder: Folder) -> ScanResult:
        pose = self.frame @ self.refined.poses[index]
        origin = folder.load(index).origin
        late = self.relocalized.get(index)
        if late is not None and late.placement is not None:
            found, path = late.placement, (*self.solution.paths.get(late.beside, ()), index)
        else:
            found, path = _of_edges(edges), self.solution.paths[index]
        placement = replace(
            found,
            map_from_scan=pose,
            sensor_origin=None if origin is None else transformed(origin[None], pose)[0],
            uncertainty=self.refined.uncertainties[index] if len(self.refined.poses) > 1 else None,
            path=path,
        )
        return ScanResult(
            name=name, placement=placement, fitness=placement.fitness, inlier_rmse=placement.inlier_rmse
        )

    def _left_out(self, index: int, name: str) -> ScanResult:
        """Why: the file, the scan by itself, the search for it, or what its neighbours saw."""
        read, late = self.read[index], self.relocalized.get(index)
        reason = read.error or read.reason or (None if late is None else late.reason)
        if reason is None:
            reason = f"scan {name}: it contradicts what its neighbours saw as free space; scan there again"
        return ScanResult(
            name=name,
            placement=None,
            reason=str(reason),
            fitness=None if late is None else late.fitness,
            inlier_rmse=None if late is None else late.inlier_rmse,
        )


def _of_edges(edges: Sequence[PairResult]) -> RegistrationResult:
    """The numbers of a scan: means over its registrations, and the best cover."""
    best = max(edges, key=lambda edge: edge.score, default=None)
    return RegistrationResult(
        map_from_scan=np.eye(4),
        sensor_origin=None,
        fitness=float(np.mean([edge.fitness for edge in edges])) if edges else None,
        inlier_rmse=float(np.mean([edge.inlier_rmse for edge in edges])) if edges else None,
        overlap=1.0 if best is None else best.overlap,
        agreement=1.0 if best is None else best.agreement,
        searched=best is not None and not best.consistent_with_prior,
        uncertainty=None,
    )


def _by_scan(edges: Sequence[PairResult]) -> defaultdict[int, list[PairResult]]:
    by_scan: defaultdict[int, list[PairResult]] = defaultdict(list)
    for edge in edges:
        by_scan[edge.target].append(edge)
        by_scan[edge.source].append(edge)
    return by_scan


_FEW = 4  # scans up to which processes cost more than they bring


def register_map_scans(
    files: Sequence[ScanFile],
    *,
    settings: MultiScanSettings,
    memory: PairCache | None = None,
    processes: int | None = None,
    progress: Progress = no_progress,
) -> MapRegistration:
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
                    memory=NullPairCache() if memory is None else memory,
                ),
                progress=monotonic_progress(progress),
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

    def run(self) -> MapRegistration:
        """The whole of it, in order."""
        read = self._read()
        sound = self._sound(read)
        pairs, solution = self._connected(sound)
        self.progress("registering", 1.0)
        self.progress("refining", 0.0)
        tied = [(edge.target, edge.source) for edge in solution.kept]
        refined = self._refined(solution, solution.poses, sound, also=tied, first=True)
        relocalized: dict[int, Relocalized] = {}
        while missing := sorted(set(sound) - set(refined.poses)):
            tried = relocalize(missing, refined.poses, solution.reference, sound, self.work)
            found = {number: each.pose for number, each in tried.items() if each.pose is not None}
            relocalized |= tried
            if not found:
                break
            before = len(refined.poses)
            tied += [(relocalized[number].beside, number) for number in found]
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
            relocalized=relocalized,
            frame=map_from_reference(refined.poses, priors, solution.reference),
        )
        return result.placed(self.files, self.work.folder)

    def _read(self) -> dict[int, Read]:
        tasks = [
            PrepareTask(
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

    def _sound(self, read: Mapping[int, Read]) -> dict[int, ValidScan]:
        """The scans that can hold a pose; raises where there is none."""
        sound = {}
        for index, each in sorted(read.items()):
            if each.points is not None and each.sensor_pose is not None:
                sound[index] = ValidScan(points=each.points, prior=self.files[index].start(each.sensor_pose))
        if sound:
            return sound
        errors = [read[index].error for index in sorted(read) if read[index].error]
        if len(errors) == len(read) and errors[0] is not None:
            raise errors[0]
        raise MapFailed("; ".join(str(each.error or each.reason) for _, each in sorted(read.items())))

    def _connected(self, sound: Mapping[int, ValidScan]) -> tuple[list[PairResult], Solution]:
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
        self, numbers: Sequence[int], pairs: Sequence[PairResult], sound: Mapping[int, ValidScan]
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
        sound: Mapping[int, ValidScan],
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
            worst = max(refined.free_space_violation, key=lambda number: refined.free_space_violation[number])
            if (
                refined.free_space_violation[worst] <= self.registration.max_free_space_violation
                or worst == solution.reference
            ):
                return refined
            current = {number: pose for number, pose in refined.poses.items() if number != worst}
