"""Pairs that were registered already, so that a build that was killed goes on and does not begin anew."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from worker.cloud.poses import inverse
from worker.cloud.types import Floats, Matrix4, Points
from worker.pipeline.mapping.pair_selection import Extent, best_pairs, overlap_rank
from worker.pipeline.mapping.settings import MapSettings
from worker.pipeline.mapping.tasks import (
    Folder,
    Found,
    RegisterTask,
    SearchTask,
    register_pairs,
    search,
)
from worker.pipeline.registration.scan_to_scan import PairResult
from worker.pipeline.registration.settings import RegistrationSettings
from worker.processes import Processes


class PairCache(Protocol):
    """Keeps results of one build; what it gives back may be any part of what it was given."""

    def load(self) -> Iterable[PairResult]:
        """What an earlier run of this build left."""
        ...

    def save(self, results: Iterable[PairResult]) -> None:
        """Called with a few results at a time, seconds apart at most."""
        ...


class NullPairCache:
    """Keeps nothing: for builds that nobody would start again."""

    def load(self) -> Iterable[PairResult]:
        """Nothing."""
        return ()

    def save(self, results: Iterable[PairResult]) -> None:
        """Nothing."""


Share = Callable[[float], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class ValidScan:
    """A scan that was read and can hold a pose."""

    points: Points  #: (N, 3) metres, scan frame, thinned: for its extent
    prior: Matrix4 | None  #: map_from_scan as the robot believes it


@dataclass(frozen=True, kw_only=True, slots=True)
class PairWork:
    """What pairing needs beside the scans."""

    folder: Folder
    processes: Processes
    registration: RegistrationSettings
    mapping: MapSettings
    memory: PairCache


@dataclass(frozen=True, kw_only=True, slots=True)
class PairPlan:
    """Every pair that may be worth an ICP, ranked."""

    numbers: list[int]  #: indices of the scans, ascending
    rank: Floats  #: (S, S) 0..1; by the priors' boxes, or by how much of a scan was found in the other
    starts: dict[tuple[int, int], tuple[Matrix4, ...]]  #: (lower, higher): where a searched pair was found

    def first(self, mapping: MapSettings) -> list[tuple[int, int]]:
        """The pairs to begin with: a few that each scan proposes."""
        searched = np.zeros_like(self.rank, dtype=bool)
        at = {number: row for row, number in enumerate(self.numbers)}
        for a, b in self.starts:
            searched[at[a], at[b]] = searched[at[b], at[a]] = True
        by_prior = best_pairs(self.numbers, np.where(searched, 0.0, self.rank), mapping.partners)
        by_search = best_pairs(self.numbers, np.where(searched, self.rank, 0.0), mapping.searched_partners)
        return sorted({*by_prior, *by_search})

    def across(
        self, parts: Sequence[Sequence[int]], tried: Collection[tuple[int, int]], mapping: MapSettings
    ) -> list[tuple[int, int]]:
        """The best pairs between scans of different parts that were not tried yet."""
        at = {number: row for row, number in enumerate(self.numbers)}
        open_ = np.ones_like(self.rank, dtype=bool)
        for part in parts:
            rows = [at[number] for number in part]
            open_[np.ix_(rows, rows)] = False
        for a, b in tried:
            open_[at[a], at[b]] = open_[at[b], at[a]] = False
        return best_pairs(self.numbers, np.where(open_, self.rank, 0.0), mapping.partners_across)


def plan_pairs(scans: Mapping[int, ValidScan], work: PairWork, *, progress: Share) -> PairPlan:
    """Rank the pairs: scans with a prior by where the priors put them, the others by looking for them in all scans."""
    numbers = sorted(scans)
    extents = {
        number: Extent.of(scan.points, scan.prior) for number, scan in scans.items() if scan.prior is not None
    }
    rank = np.zeros((len(numbers), len(numbers)))
    known = [row for row, number in enumerate(numbers) if number in extents]
    rank[np.ix_(known, known)] = overlap_rank(extents, work.mapping)
    lost = [number for number in numbers if number not in extents]
    at = {number: row for row, number in enumerate(numbers)}
    starts = {}
    for found in _search_all(scans, lost, work, progress=progress) if lost else ():
        a, b = at[found.target], at[found.source]
        rank[a, b] = rank[b, a] = found.score
        starts[found.target, found.source] = tuple(pose.target_from_source for pose in found.poses)
    return PairPlan(numbers=numbers, rank=rank, starts=starts)


def _search_all(
    scans: Mapping[int, ValidScan], lost: Sequence[int], work: PairWork, *, progress: Share
) -> list[Found]:
    """Every pair with a scan that has no prior, looked at once."""
    unknown = set(lost)
    tasks = []
    for source in sorted(scans):
        targets = [other for other in scans if other < source and (source in unknown or other in unknown)]
        tasks += [
            SearchTask(
                folder=work.folder,
                source=source,
                targets=tuple(targets[first : first + 25]),
                candidates=work.mapping.candidates,
                settings=work.registration,
            )
            for first in range(0, len(targets), 25)
        ]
    return list(_gathered(work.processes.each(search, tasks), len(tasks), progress))


def register_planned(
    pairs: Sequence[tuple[int, int]],
    plan: PairPlan,
    scans: Mapping[int, ValidScan],
    work: PairWork,
    *,
    progress: Share,
) -> list[PairResult]:
    """The registrations of these pairs, sorted; what an earlier run left is not done again.

    By target, for its tree is then built once.
    """
    wanted = set(pairs)
    done = {(each.target, each.source): each for each in work.memory.load()}
    done = {pair: result for pair, result in done.items() if pair in wanted}
    by_target = defaultdict(list)
    for target, source in pairs:
        if (target, source) not in done:
            prior = _prior(scans[target], scans[source])
            by_target[target].append((source, prior, plan.starts.get((target, source), ())))
    tasks = [
        RegisterTask(folder=work.folder, target=target, sources=tuple(sources), settings=work.registration)
        for target, sources in sorted(by_target.items())
    ]
    for number, batch in enumerate(work.processes.each(register_pairs, tasks), start=1):
        work.memory.save(batch)
        done |= {(result.target, result.source): result for result in batch}
        progress(number / len(tasks))
    return [done[pair] for pair in sorted(done)]


def _prior(target: ValidScan, source: ValidScan) -> Matrix4 | None:
    if target.prior is None or source.prior is None:
        return None
    target_from_source: Matrix4 = inverse(target.prior) @ source.prior
    return target_from_source


def _gathered(batches: Iterator[list[Found]], count: int, progress: Share) -> Iterator[Found]:
    for number, batch in enumerate(batches, start=1):
        yield from batch
        progress(number / count)
