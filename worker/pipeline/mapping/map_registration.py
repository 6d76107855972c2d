"""Map registration: a pose for every scan among the others, and the totals of the paper's Table 2."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np

from worker.cloud.poses import inverse, transformed
from worker.cloud.sight import Sights
from worker.cloud.types import Matrix4
from worker.errors import MapFailed, ScanError
from worker.pipeline.mapping.multiview_refinement import Refined, refine_jointly
from worker.pipeline.mapping.outlier_rejection import find_violations, most_voted
from worker.pipeline.mapping.pair_registration import (
    NullPairCache,
    Pair,
    PairCache,
    plan_pairs,
    register_planned,
)
from worker.pipeline.mapping.pose_graph import Solution, components, map_from_reference, solve_graph
from worker.pipeline.mapping.refusals import explained, may_be_explained
from worker.pipeline.mapping.relocalization import Relocalized, relocalize
from worker.pipeline.mapping.settings import JointRegistrationSettings
from worker.pipeline.mapping.tasks import (
    PlaceTask,
    PrepareTask,
    ValidScan,
    Workspace,
    lay_together,
    open_workspace,
    read_and_prepare,
)
from worker.pipeline.placement.contradictions import Place
from worker.pipeline.placement.scan_placement import turned_up
from worker.pipeline.registration.diagnosis import Reason, without_doubles
from worker.pipeline.registration.results import RegistrationResult, ScanFile, ScanRejected, ScanResult
from worker.pipeline.registration.scan_to_scan import PairResult
from worker.processes import default_processes
from worker.progress import Progress, advancing, monotonic_progress, no_progress

_FEW = 4  # scans up to which processes cost more than they bring
_FIRST_REFINEMENT, _REFINEMENTS = 0.6, 0.9  # of the stage's progress
_TRUE_CAUSES: tuple[Reason, ...] = ("mirrored", "wrong_scale", "wrong_prior", "ambiguous")

Scans = Mapping[int, ValidScan]  #: by index of the file
Prepared = Mapping[int, ValidScan | ScanError | ScanRejected]  #: likewise; why a scan is not valid


@dataclass(frozen=True, kw_only=True, slots=True)
class MapReport:
    """Totals; means and deviations are over the registrations that the map rests on, None where there is none."""

    scans: int
    accepted: int
    discarded: int
    pairs_possible: int  #: scans * (scans - 1) / 2; of a survey one a scan, to the map
    pairs_tried: int  #: by ICP
    calls_saved: float  #: share of the possible pairs that needed no ICP, 0..1
    pairs_accepted: int  #: by their own numbers
    pairs_contradicted: int  #: of those, rejected because loops do not close over them
    mean_rmse: float | None  #: metres
    std_rmse: float | None  #: metres
    mean_fitness: float | None  #: 0..1
    std_fitness: float | None
    reference: int | None  #: index of the reference scan; None where the map was there before

    @classmethod
    def of(
        cls,
        results: Sequence[ScanResult],
        *,
        pairs: Sequence[PairResult] | None = None,
        kept: Sequence[PairResult] = (),
        reference: int | None = None,
    ) -> Self:
        """Count results; `pairs` are all that were tried, `kept` those that the map rests on.

        Without pairs the scans were registered to a map that was there: each has one registration, to the map.
        """
        accepted = [result for result in results if result.registration is not None]
        if pairs is None:
            possible = tried = len(results)
            agreed, edges = len(accepted), [(scan.fitness, scan.inlier_rmse) for scan in accepted]
        else:
            possible, tried = len(results) * (len(results) - 1) // 2, len(pairs)
            agreed = sum(pair.accepted for pair in pairs)
            edges = [(pair.fitness, pair.inlier_rmse) for pair in kept]
        fitness, rmse = np.array(edges, np.float64).reshape(-1, 2).T
        return cls(
            scans=len(results),
            accepted=len(accepted),
            discarded=len(results) - len(accepted),
            pairs_possible=possible,
            pairs_tried=tried,
            calls_saved=1 - tried / possible if possible else 0.0,
            pairs_accepted=agreed,
            pairs_contradicted=agreed - len(edges),
            mean_rmse=float(rmse.mean()) if edges else None,
            std_rmse=float(rmse.std()) if edges else None,
            mean_fitness=float(fitness.mean()) if edges else None,
            std_fitness=float(fitness.std()) if edges else None,
            reference=reference,
        )

    def document(self) -> dict[str, Any]:
        """Return it as JSON."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True, slots=True)
class MapRegistration:
    """Every scan's outcome, in the order of the files, and how it came about."""

    outcomes: tuple[ScanResult, ...]
    report: MapReport
    kept: tuple[PairResult, ...]  #: the registrations that the map rests on
    rejected: tuple[PairResult, ...]  #: accepted ones that loops or free space contradict


def register_map_scans(
    files: Sequence[ScanFile],
    *,
    settings: JointRegistrationSettings,
    pair_cache: PairCache | None = None,
    processes: int | None = None,
    progress: Progress = no_progress,
) -> MapRegistration:
    """Find a pose for every scan that has one among the others; name the rest with a reason.

    `processes` is one a core if None. Raises MapFailed where no scan can hold a pose, and ScanError where none can
    be read.
    """
    count = default_processes() if processes is None else processes
    with open_workspace(settings, processes=1 if len(files) <= _FEW else count) as workspace:
        build = _Build(
            files=files,
            workspace=workspace,
            pair_cache=NullPairCache() if pair_cache is None else pair_cache,
            progress=monotonic_progress(progress),
        )
        return build.run()


@dataclass(frozen=True, kw_only=True, slots=True)
class _Build:
    """One build: its inputs, and each step as a method."""

    files: Sequence[ScanFile]
    workspace: Workspace
    pair_cache: PairCache
    progress: Progress

    def run(self) -> MapRegistration:
        """Run the steps in order."""
        prepared = self._prepare()
        scans = self._valid(prepared)
        pairs, graph = self._connect(scans)
        refined, relocalized = self._refine_and_relocalize(scans, graph)
        kept = tuple(edge for edge in graph.kept if refined.poses.keys() >= set(edge.pair))
        relocalized = {**relocalized, **self._explained(scans, graph.reference, refined, relocalized)}
        self.progress("refining", 1.0)
        results = self._results(prepared, replace(graph, kept=kept), refined, relocalized)
        report = MapReport.of(results, pairs=pairs, kept=kept, reference=graph.reference)
        return MapRegistration(outcomes=results, report=report, kept=kept, rejected=graph.rejected)

    def _prepare(self) -> Prepared:
        """Read every file; return the scans that can hold a pose, and for the others why they cannot."""
        settings, folder = self.workspace.settings, self.workspace.folder
        tasks = [
            PrepareTask(folder=folder, index=index, file=file, settings=settings)
            for index, file in enumerate(self.files)
        ]
        prepared = {}
        for count, (index, scan) in enumerate(
            self.workspace.processes.map_unordered(read_and_prepare, tasks)
        ):
            prepared[index] = scan
            self.progress("reading", count / len(tasks))
        self.progress("reading", 1.0)
        return dict(sorted(prepared.items()))

    def _valid(self, prepared: Prepared) -> Scans:
        """Return the scans that can hold a pose; raise where there is none."""
        scans = {index: scan for index, scan in prepared.items() if isinstance(scan, ValidScan)}
        if scans:
            return scans
        errors = [error for error in prepared.values() if isinstance(error, ScanError)]
        if errors and len(errors) == len(prepared):
            raise errors[0]
        raise MapFailed("; ".join(map(str, prepared.values())))

    def _connect(self, scans: Scans) -> tuple[list[PairResult], Solution]:
        """Register the likeliest pairs; as long as that leaves several components, the likeliest between them too."""
        settings = self.workspace.settings.mapping
        planning = 0.5 if any(scan.prior is None for scan in scans.values()) else 0.0
        span = (1 - planning) / settings.pairing_rounds
        plan = plan_pairs(scans, self.workspace, progress=self._registering(0.0, planning))
        wanted, pairs = plan.first(settings), []
        for number in range(settings.pairing_rounds):
            progress = self._registering(planning + span * number, span)
            pairs += register_planned(wanted, plan, scans, self.workspace, self.pair_cache, progress=progress)
            graph = self._solve(pairs, scans)
            joined = components(plan.indices, [*graph.kept, *graph.elsewhere])
            wanted = plan.across(joined, {pair.pair for pair in pairs}, settings)
            if not wanted:
                break
        self.progress("registering", 1.0)
        return pairs, graph

    def _registering(self, begin: float, span: float) -> Callable[[float], None]:
        return lambda share: self.progress("registering", begin + span * share)

    def _solve(self, pairs: Sequence[PairResult], scans: Scans) -> Solution:
        """Solve the graph without the edges that free space votes out, one after the other."""
        settings = self.workspace.settings.mapping
        points = {index: scan.points for index, scan in scans.items()}
        outliers: list[PairResult] = []
        while True:
            inliers = [pair for pair in pairs if not any(pair is outlier for outlier in outliers)]
            graph = solve_graph(list(scans), inliers, settings)
            violations = find_violations(graph.poses, points, self.workspace)
            worst = most_voted(list(graph.poses), graph.kept, violations, settings)
            if worst is None:
                return replace(graph, rejected=(*graph.rejected, *outliers))
            outliers.append(worst)

    def _refine_and_relocalize(self, scans: Scans, graph: Solution) -> tuple[Refined, dict[int, Relocalized]]:
        """Refine what the graph holds; look for the missing scans in it, and refine again, as long as one is found."""
        self.progress("refining", 0.0)
        ties = [edge.pair for edge in graph.kept]
        refined = self._refine(graph.poses, scans, graph.reference, ties, span=_FIRST_REFINEMENT)
        relocalized: dict[int, Relocalized] = {}
        while missing := sorted(set(scans) - set(refined.poses)):
            attempts = relocalize(missing, refined.poses, graph.reference, scans, self.workspace)
            relocalized |= attempts
            poses = {index: item.pose for index, item in attempts.items() if item.pose is not None}
            if not poses:
                break
            before = len(refined.poses)
            ties += [(attempts[index].nearest, index) for index in poses]
            together = refined.poses | poses
            refined = self._refine(together, scans, graph.reference, ties, span=_REFINEMENTS)
            if len(refined.poses) <= before:  # what was found is contradicted by the others
                break
        self.progress("refining", _REFINEMENTS)
        return refined, relocalized

    def _explained(
        self, scans: Scans, reference: int, refined: Refined, relocalized: Mapping[int, Relocalized]
    ) -> dict[int, Relocalized]:
        """Return the scans left out for which there is a better reason: mirrored, scaled, a prior kilometres off."""
        left_out: dict[int, Exception] = {
            index: ScanRejected(item.result.diagnosis)
            for index, item in relocalized.items()
            if index not in refined.poses and item.pose is None and item.result.diagnosis is not None
        }
        doubtful = [index for index, error in left_out.items() if may_be_explained(error)]
        if not doubtful:
            return {}
        place = self._place_of(refined.poses)
        map_index = -len(self.files) - 1  # below that of every map that scans were relocalized in
        self.workspace.folder.save_map(map_index, place.surface, place.sights)
        priors = {index: scan.prior for index, scan in scans.items() if scan.prior is not None}
        reference_from_map = inverse(map_from_reference(refined.poses, priors, reference))
        in_reference = {index: reference_from_map @ priors[index] for index in left_out if index in priors}
        tick = advancing(self.progress, "refining", _REFINEMENTS, 1.0)
        wanted = doubtful[: self.workspace.settings.placement.diagnosed]
        errors = left_out | self._placed_again(wanted, in_reference, place, map_index, tick)
        better = explained(
            errors, self.files, in_reference, place, self.workspace, map_index=map_index, tick=tick
        )
        own = {index: error for index, error in errors.items() if _is_told(error)}
        return {
            index: Relocalized(index=index, result=ScanResult.rejected(self.files[index].name, error))
            for index, error in (own | better).items()
        }

    def _placed_again(
        self,
        wanted: Sequence[int],
        priors: Mapping[int, Matrix4],
        place: Place,
        map_index: int,
        tick: Callable[[], None],
    ) -> dict[int, Exception]:
        """Place scans, by index, in the whole of what was registered, as scans of a survey are; return the refusals."""
        refused: dict[int, Exception] = {}
        for index in wanted:
            task = PlaceTask(
                folder=self.workspace.folder,
                map_index=map_index,
                index=index,
                prior=priors.get(index),
                settings=self.workspace.settings,
            )
            found = task.run(place, tick=tick)
            if isinstance(found, ScanRejected):
                refused[index] = found
        return refused

    def _place_of(self, poses: Mapping[int, Matrix4]) -> Place:
        """Return what was registered as a place to hold other scans against, in the frame of the poses."""
        folder = self.workspace.folder
        voxel_size = self.workspace.settings.registration.voxel_size
        seen = []
        for index, pose in poses.items():
            scan = folder.load(index)
            if scan.origin is not None:
                seen.append((transformed(scan.surface.points, pose), transformed(scan.origin[None], pose)[0]))
        surface = lay_together(folder, list(poses.items()), voxel_size=voxel_size)
        return Place(surface=surface, sights=Sights.of(seen) if seen else None)

    def _refine(
        self,
        poses: Mapping[int, Matrix4],
        scans: Scans,
        reference: int,
        ties: Sequence[Pair],
        *,
        span: float,
    ) -> Refined:
        """Refine jointly; leave out, worst first, what the free space of the others contradicts, and refine again."""
        limit = self.workspace.settings.registration.max_free_space_violation
        while True:
            refined = refine_jointly(
                poses,
                {index: scans[index].points for index in poses},
                self.workspace,
                fixed=reference,
                ties=ties,
                progress=lambda share: self.progress("refining", span * share),
            )
            violations = refined.free_space_violation
            worst = max(violations, key=lambda index: violations[index])
            if violations[worst] <= limit or worst == reference:
                return refined
            poses = {index: pose for index, pose in refined.poses.items() if index != worst}

    def _results(
        self,
        prepared: Prepared,
        graph: Solution,
        refined: Refined,
        relocalized: Mapping[int, Relocalized],
    ) -> tuple[ScanResult, ...]:
        """Return what became of each file: registered in the map's frame, or left out with a reason."""
        priors = {
            index: scan.prior
            for index, scan in prepared.items()
            if isinstance(scan, ValidScan) and scan.prior is not None
        }
        frame = map_from_reference(refined.poses, priors, graph.reference)
        results = []
        for index, scan in prepared.items():
            name, late = self.files[index].name, relocalized.get(index)
            odd = scan.oddities if isinstance(scan, ValidScan) else ()
            if index in refined.poses:
                registration = self._registration(index, graph, refined, late, frame)
                told = without_doubles((*turned_up(name, registration.map_from_scan), *odd))
                results.append(ScanResult.accepted(name, registration, warnings=told))
            elif isinstance(scan, Exception):
                results.append(ScanResult.rejected(name, scan))
            elif late is not None and late.pose is None:
                results.append(replace(late.result, warnings=odd))
            else:
                detail = (
                    f"scan {name}: it contradicts what its neighbours saw as free space; scan there again"
                )
                error = ScanRejected.because("disagrees", detail)
                results.append(ScanResult.rejected(name, error, warnings=odd))
        return tuple(results)

    def _registration(
        self, index: int, graph: Solution, refined: Refined, late: Relocalized | None, frame: Matrix4
    ) -> RegistrationResult:
        """Return the numbers of its own registrations, or of its relocalization, at the refined pose."""
        pose = frame @ refined.poses[index]
        origin = self.workspace.folder.load(index).origin
        if late is not None and late.result.registration is not None:
            registration = late.result.registration
            path = (*graph.paths.get(late.nearest, ()), index)
        else:
            registration = _mean_of_edges([edge for edge in graph.kept if index in edge.pair])
            path = graph.paths[index]
        return replace(
            registration,
            map_from_scan=pose,
            sensor_origin=None if origin is None else transformed(origin[None], pose)[0],
            uncertainty=refined.uncertainties[index] if len(refined.poses) > 1 else None,
            path=path,
        )


def _is_told(error: Exception) -> bool:
    """Tell whether the search for the scan itself found a true cause."""
    return isinstance(error, ScanRejected) and error.diagnosis.reason in _TRUE_CAUSES


def _mean_of_edges(edges: Sequence[PairResult]) -> RegistrationResult:
    """Return the numbers of a scan: means over its registrations, and the best cover."""
    best = max(edges, key=lambda edge: edge.score, default=None)
    return RegistrationResult(
        map_from_scan=np.eye(4),
        sensor_origin=None,
        fitness=float(np.mean([edge.fitness for edge in edges])) if edges else None,
        inlier_rmse=float(np.mean([edge.inlier_rmse for edge in edges])) if edges else None,
        overlap=1.0 if best is None else best.overlap,
        two_way_inlier_ratio=1.0 if best is None else best.two_way_inlier_ratio,
        from_global_search=best is not None and not best.consistent_with_prior,
        uncertainty=None,
    )
