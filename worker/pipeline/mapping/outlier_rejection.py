"""Outlier rejection: registrations that lay scans into what others saw as free, found by voting.

A wrong registration between two groups of scans that agree within themselves closes no loop that could tell. But then
scans of one group stand in the free space of the other, many of them, and every path between them goes over the wrong
registration: each such pair votes for the edges on its path, the doubtful ones first.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence

from worker.cloud.types import Matrix4, Points
from worker.pipeline.mapping.pair_selection import Extent, likely_pairs
from worker.pipeline.mapping.pose_graph import most_reliable_tree, reliability
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.mapping.tasks import FreeSpaceTask, Violation, Workspace, check_free_space
from worker.pipeline.registration.scan_to_scan import PairResult

_NEIGHBOURS = 8  # that are asked of each scan


def find_violations(
    poses: Mapping[int, Matrix4], points: Mapping[int, Points], workspace: Workspace
) -> list[Violation]:
    """Return the neighbours under these poses that contradict each other, sorted; `points` are downsampled scans."""
    settings = workspace.settings.mapping
    extents = {index: Extent.of(points[index], pose) for index, pose in poses.items()}
    near = defaultdict(list)
    for target, source in likely_pairs(extents, settings, partners=_NEIGHBOURS):
        near[target].append((source, poses[source]))
    tasks = [
        FreeSpaceTask(folder=workspace.folder, target=(target, poses[target]), sources=tuple(sources))
        for target, sources in near.items()
    ]
    batches = workspace.processes.map_unordered(check_free_space, tasks)
    violations = (item for batch in batches for item in batch if item.share > settings.max_contradiction)
    return sorted(violations, key=lambda item: (item.target, item.source))


def most_voted(
    scans: Sequence[int],
    edges: Sequence[PairResult],
    violations: Sequence[Violation],
    settings: MappingSettings,
) -> PairResult | None:
    """Return the edge that most violations vote for; None where no edge lies between them."""
    paths = most_reliable_tree(scans, edges, settings).paths
    doubt_of = {
        frozenset(edge.pair): 1 - trust
        for edge, trust in zip(edges, reliability(edges, settings), strict=True)
    }
    votes: defaultdict[frozenset[int], float] = defaultdict(float)
    for violation in violations:
        links = _between(paths[violation.target], paths[violation.source])
        total = sum(doubt_of[link] for link in links)
        for link in links:
            votes[link] += doubt_of[link] / total
    if not votes:
        return None
    worst = max(votes, key=lambda link: (votes[link], sorted(link)))
    return next(edge for edge in edges if frozenset(edge.pair) == worst)


def _between(a: Sequence[int], b: Sequence[int]) -> list[frozenset[int]]:
    """Return the links of a tree on the way from the end of one path from its root to the end of another."""
    links = [{frozenset(link) for link in itertools.pairwise(path)} for path in (a, b)]
    return sorted(links[0] ^ links[1], key=sorted)
