"""What came of placing: an outcome for every file, and the totals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from worker.pipeline.map_report import MapReport
from worker.pipeline.pair_work import Folder, Read
from worker.pipeline.pairwise import PairResult
from worker.pipeline.placement import Outcome, Placement, ScanFile
from worker.pipeline.poses import transformed
from worker.pipeline.refinement import Refined
from worker.pipeline.rescue import Rescued
from worker.pipeline.solution import Solution
from worker.pipeline.values import Matrix4


@dataclass(frozen=True, kw_only=True, slots=True)
class Placed:
    """Every scan's outcome, in the order of the files, and how it came about."""

    outcomes: tuple[Outcome, ...]
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
    rescued: Mapping[int, Rescued]
    frame: Matrix4  #: (4, 4) map from the reference scan's frame

    def placed(self, files: Sequence[ScanFile], folder: Folder) -> Placed:
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
        return Placed(outcomes=outcomes, report=report, kept=kept, contradicted=self.solution.contradicted)

    def _accepted(self, index: int, name: str, edges: Sequence[PairResult], folder: Folder) -> Outcome:
        pose = self.frame @ self.refined.poses[index]
        origin = folder.load(index).origin
        late = self.rescued.get(index)
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
        return Outcome(
            name=name, placement=placement, fitness=placement.fitness, inlier_rmse=placement.inlier_rmse
        )

    def _left_out(self, index: int, name: str) -> Outcome:
        """Why: the file, the scan by itself, the search for it, or what its neighbours saw."""
        read, late = self.read[index], self.rescued.get(index)
        reason = read.error or read.reason or (None if late is None else late.reason)
        if reason is None:
            reason = f"scan {name}: it contradicts what its neighbours saw as free space; scan there again"
        return Outcome(
            name=name,
            placement=None,
            reason=str(reason),
            fitness=None if late is None else late.fitness,
            inlier_rmse=None if late is None else late.inlier_rmse,
        )


def _of_edges(edges: Sequence[PairResult]) -> Placement:
    """The numbers of a scan: means over its registrations, and the best cover."""
    best = max(edges, key=lambda edge: edge.score, default=None)
    return Placement(
        map_from_scan=np.eye(4),
        sensor_origin=None,
        fitness=float(np.mean([edge.fitness for edge in edges])) if edges else None,
        inlier_rmse=float(np.mean([edge.inlier_rmse for edge in edges])) if edges else None,
        overlap=1.0 if best is None else best.overlap,
        agreement=1.0 if best is None else best.agreement,
        searched=best is not None and not best.vouched,
        uncertainty=None,
    )


def _by_scan(edges: Sequence[PairResult]) -> defaultdict[int, list[PairResult]]:
    by_scan: defaultdict[int, list[PairResult]] = defaultdict(list)
    for edge in edges:
        by_scan[edge.target].append(edge)
        by_scan[edge.source].append(edge)
    return by_scan
