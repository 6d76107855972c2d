"""Registrations that lay scans into what others saw as empty, found by a vote.

A wrong registration between two groups of scans that agree within themselves closes no loop that could tell. But then
scans of one group stand in the free space of the other, many of them, and every path between them goes over the wrong
registration: each such pair votes for the edges on its path, the doubtful ones first.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from worker.cloud.types import Matrix4, Points
from worker.pipeline.mapping.pair_selection import Extent, likely_pairs
from worker.pipeline.mapping.pose_graph import most_reliable_tree, reliability
from worker.pipeline.mapping.settings import MapSettings
from worker.pipeline.mapping.tasks import Folder, FreeSpaceTask, glance
from worker.pipeline.registration.scan_to_scan import PairResult
from worker.processes import Processes

_NEIGHBOURS = 8  # that are asked of each scan


@dataclass(frozen=True, kw_only=True, slots=True)
class Contradiction:
    """Two scans of which one stands in what the other saw through."""

    target: int
    source: int
    share: float  #: of points, the worse direction, 0..1


def contradictions(
    poses: Mapping[int, Matrix4],
    points: Mapping[int, Points],
    folder: Folder,
    processes: Processes,
    *,
    limit: float,
    settings: MapSettings,
) -> list[Contradiction]:
    """The neighbours under these poses of whom more than `limit` (0..1) stands in free space; `points` are thinned."""
    extents = {scan: Extent.of(points[scan], pose) for scan, pose in poses.items()}
    near = defaultdict(list)
    for target, source in likely_pairs(extents, settings.model_copy(update={"partners": _NEIGHBOURS})):
        near[target].append((source, poses[source]))
    tasks = [
        FreeSpaceTask(folder=folder, target=(target, poses[target]), sources=tuple(sources))
        for target, sources in near.items()
    ]
    return sorted(
        (
            Contradiction(target=target, source=source, share=share)
            for batch in processes.each(glance, tasks)
            for target, source, share in batch
            if share > limit
        ),
        key=lambda each: (each.target, each.source),
    )


def most_accused(
    scans: Sequence[int],
    edges: Sequence[PairResult],
    found: Sequence[Contradiction],
    settings: MapSettings,
) -> PairResult | None:
    """The edge that most contradictions hang on; None where no edge lies between them."""
    paths = most_reliable_tree(scans, edges, settings).paths
    trust = {
        frozenset((edge.target, edge.source)): value
        for edge, value in zip(edges, reliability(edges, settings), strict=True)
    }
    votes: defaultdict[frozenset[int], float] = defaultdict(float)
    for each in found:
        links = _between(paths[each.target], paths[each.source])
        doubts = {link: 1 - trust[link] for link in links}
        for link, doubt in doubts.items():
            votes[link] += doubt / sum(doubts.values())
    if not votes:
        return None
    worst = max(votes, key=lambda link: (votes[link], sorted(link)))
    return next(edge for edge in edges if frozenset((edge.target, edge.source)) == worst)


def _between(a: Sequence[int], b: Sequence[int]) -> list[frozenset[int]]:
    """The links of a tree on the way from the end of one path from its root to the end of another."""
    links = [{frozenset(link) for link in itertools.pairwise(path)} for path in (a, b)]
    return sorted(links[0] ^ links[1], key=sorted)
