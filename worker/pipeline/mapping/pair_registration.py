"""Pair registration: which pairs of scans are worth an ICP, and their registrations, kept over a restart."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from worker.cloud.poses import inverse
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.mapping.pair_selection import Extent, best_pairs, overlap_rank
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.mapping.tasks import (
    RegisterTask,
    SearchResult,
    SearchTask,
    ValidScan,
    Workspace,
    register_pairs,
    search,
)
from worker.pipeline.registration.scan_to_scan import PairResult

_TARGETS = 25  # of one search task

Share = Callable[[float], None]
Pair = tuple[int, int]  #: target and source; in a plan the lower index comes first


class PairCache(Protocol):
    """Keeps the pairs of one build, so that one that was killed goes on; it may give back any part of them."""

    def load(self) -> Iterable[PairResult]:
        """Load what an earlier run of this build left."""

    def save(self, results: Iterable[PairResult]) -> None:
        """Keep a few more results; called seconds apart at most."""


class NullPairCache:
    """Keeps nothing: for builds that nobody would start again."""

    def load(self) -> Iterable[PairResult]:
        """Load nothing."""
        return ()

    def save(self, results: Iterable[PairResult]) -> None:
        """Keep nothing."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PairPlan:
    """Every pair that may be worth an ICP, ranked."""

    indices: list[int]  #: of the scans, ascending
    rank: Floats  #: (S, S) 0..1; by the priors' boxes, or by how much of a scan was found in the other
    starts: dict[Pair, tuple[Matrix4, ...]]  #: (lower, higher): where a searched pair was found

    def first(self, settings: MappingSettings) -> list[Pair]:
        """Return the pairs to begin with: a few that each scan proposes."""
        searched = self._mask(self.starts)
        by_prior = best_pairs(self.indices, np.where(searched, 0.0, self.rank), settings.partners)
        by_search = best_pairs(self.indices, np.where(searched, self.rank, 0.0), settings.searched_partners)
        return sorted({*by_prior, *by_search})

    def across(
        self, components: Sequence[Sequence[int]], tried: Collection[Pair], settings: MappingSettings
    ) -> list[Pair]:
        """Return the best pairs between scans of different components that were not tried yet."""
        inside = ((a, b) for component in components for a in component for b in component)
        closed = self._mask([*inside, *tried])
        return best_pairs(self.indices, np.where(closed, 0.0, self.rank), settings.partners_across)

    def _mask(self, pairs: Iterable[Pair]) -> np.ndarray:
        """Return (S, S) bool, symmetric, true for these pairs."""
        row_of = {index: row for row, index in enumerate(self.indices)}
        mask = np.zeros_like(self.rank, dtype=bool)
        for a, b in pairs:
            mask[row_of[a], row_of[b]] = mask[row_of[b], row_of[a]] = True
        return mask


def plan_pairs(scans: Mapping[int, ValidScan], workspace: Workspace, *, progress: Share) -> PairPlan:
    """Rank the pairs: scans with a prior by where the priors put them, the others by looking for them in all scans."""
    indices = sorted(scans)
    row_of = {index: row for row, index in enumerate(indices)}
    extents = {
        index: Extent.of(scan.points, scan.prior) for index, scan in scans.items() if scan.prior is not None
    }
    rank = np.zeros((len(indices), len(indices)))
    known = [row_of[index] for index in sorted(extents)]
    rank[np.ix_(known, known)] = overlap_rank(extents, workspace.settings.mapping)
    starts = {}
    for result in _search(scans, set(indices) - set(extents), workspace, progress=progress):
        a, b = row_of[result.target], row_of[result.source]
        rank[a, b] = rank[b, a] = result.score
        starts[result.target, result.source] = tuple(pose.target_from_source for pose in result.poses)
    return PairPlan(indices=indices, rank=rank, starts=starts)


def _search(
    scans: Mapping[int, ValidScan], lost: Collection[int], workspace: Workspace, *, progress: Share
) -> list[SearchResult]:
    """Search once every pair with a scan that has no prior."""
    tasks = []
    for source in sorted(scans):
        targets = [other for other in scans if other < source and (source in lost or other in lost)]
        tasks += [
            SearchTask(
                folder=workspace.folder,
                source=source,
                targets=tuple(targets[first : first + _TARGETS]),
                candidates=workspace.settings.mapping.candidates,
                settings=workspace.settings.registration,
            )
            for first in range(0, len(targets), _TARGETS)
        ]
    results = []
    for count, batch in enumerate(workspace.processes.map_unordered(search, tasks), start=1):
        results += batch
        progress(count / len(tasks))
    return results


def register_planned(
    pairs: Sequence[Pair],
    plan: PairPlan,
    scans: Mapping[int, ValidScan],
    workspace: Workspace,
    pair_cache: PairCache,
    *,
    progress: Share,
) -> list[PairResult]:
    """Register these pairs; return them sorted. What the cache has is not done again.

    By target, for its tree is then built once.
    """
    wanted = set(pairs)
    results = {result.pair: result for result in pair_cache.load() if result.pair in wanted}
    by_target = defaultdict(list)
    for target, source in pairs:
        if (target, source) not in results:
            prior = _prior(scans[target], scans[source])
            by_target[target].append((source, prior, plan.starts.get((target, source), ())))
    tasks = [
        RegisterTask(
            folder=workspace.folder,
            target=target,
            sources=tuple(sources),
            settings=workspace.settings.registration,
        )
        for target, sources in sorted(by_target.items())
    ]
    for count, batch in enumerate(workspace.processes.map_unordered(register_pairs, tasks), start=1):
        pair_cache.save(batch)
        results |= {result.pair: result for result in batch}
        progress(count / len(tasks))
    return [results[pair] for pair in sorted(results)]


def _prior(target: ValidScan, source: ValidScan) -> Matrix4 | None:
    if target.prior is None or source.prior is None:
        return None
    target_from_source: Matrix4 = inverse(target.prior) @ source.prior
    return target_from_source
