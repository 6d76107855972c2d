"""Which pairs of scans are registered, from which start, and their registration in parallel processes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worker.pipeline.map_settings import MapSettings
from worker.pipeline.overlap import Extent, best_pairs, likely_pairs
from worker.pipeline.pair_memory import PairMemory
from worker.pipeline.pair_work import (
    Folder,
    Found,
    Pairing,
    Searching,
    register_pairs,
    search,
)
from worker.pipeline.pairwise import PairResult
from worker.pipeline.poses import inverse
from worker.pipeline.registration_settings import RegistrationSettings
from worker.pipeline.values import Matrix4, Points
from worker.processes import Processes

Share = Callable[[float], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class Sound:
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
    memory: PairMemory


def register_all(scans: Mapping[int, Sound], work: PairWork, *, progress: Share) -> list[PairResult]:
    """The pairs that are worth it, registered; sorted by target and source.

    Scans with a prior are paired by where the priors put them. The others are searched in all scans, and paired with
    those in which they were found.
    """
    extents = {
        number: Extent.of(scan.points, scan.prior) for number, scan in scans.items() if scan.prior is not None
    }
    starts: dict[tuple[int, int], tuple[Matrix4, ...]] = dict.fromkeys(
        likely_pairs(extents, work.mapping), ()
    )
    lost = [number for number in scans if number not in extents]
    if lost:
        half = 0.5
        found = _search_all(scans, lost, work, progress=lambda share: progress(half * share))
        starts |= _worth_it(found, work.mapping)
    else:
        half = 0.0
    results = _register(starts, scans, work, progress=lambda share: progress(half + (1 - half) * share))
    return sorted(results, key=lambda result: (result.target, result.source))


def _search_all(
    scans: Mapping[int, Sound], lost: Sequence[int], work: PairWork, *, progress: Share
) -> list[Found]:
    """Every pair with a scan that has no prior, looked at once."""
    unknown = set(lost)
    tasks = []
    for source in sorted(scans):
        targets = [other for other in scans if other < source and (source in unknown or other in unknown)]
        tasks += [
            Searching(
                folder=work.folder,
                source=source,
                targets=tuple(targets[first : first + 25]),
                candidates=work.mapping.candidates,
                settings=work.registration,
            )
            for first in range(0, len(targets), 25)
        ]
    return list(_gathered(work.processes.each(search, tasks), len(tasks), progress))


def _worth_it(found: Sequence[Found], mapping: MapSettings) -> dict[tuple[int, int], tuple[Matrix4, ...]]:
    """The pairs in which a scan looks most at home, with their starts."""
    numbers = sorted({number for each in found for number in (each.target, each.source)})
    at = {number: row for row, number in enumerate(numbers)}
    rank = np.zeros((len(numbers), len(numbers)))
    for each in found:
        rank[at[each.target], at[each.source]] = rank[at[each.source], at[each.target]] = each.score
    poses = {(each.target, each.source): tuple(p.target_from_source for p in each.poses) for each in found}
    return {pair: poses[pair] for pair in best_pairs(numbers, rank, mapping.searched_partners)}


def _register(
    starts: Mapping[tuple[int, int], tuple[Matrix4, ...]],
    scans: Mapping[int, Sound],
    work: PairWork,
    *,
    progress: Share,
) -> list[PairResult]:
    """All pairs by target, for its tree is then built once; what an earlier run left is not done again."""
    known = {(result.target, result.source): result for result in work.memory.load()}
    done = [known[pair] for pair in starts if pair in known]
    by_target = defaultdict(list)
    for pair in starts:
        if pair not in known:
            by_target[pair[0]].append(pair[1])
    tasks = [
        Pairing(
            folder=work.folder,
            target=target,
            sources=tuple(
                (source, _prior(scans[target], scans[source]), starts[target, source]) for source in sources
            ),
            settings=work.registration,
        )
        for target, sources in sorted(by_target.items())
    ]
    batches = work.processes.each(register_pairs, tasks)
    for number, batch in enumerate(batches, start=1):
        work.memory.save(batch)
        done += batch
        progress(number / len(tasks))
    return done


def _prior(target: Sound, source: Sound) -> Matrix4 | None:
    if target.prior is None or source.prior is None:
        return None
    target_from_source: Matrix4 = inverse(target.prior) @ source.prior
    return target_from_source


def _gathered(batches: Iterator[list[Found]], count: int, progress: Share) -> Iterator[Found]:
    for number, batch in enumerate(batches, start=1):
        yield from batch
        progress(number / count)
