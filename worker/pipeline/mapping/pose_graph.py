"""The pose graph: scans as nodes, accepted registrations as edges (paper, Section 3.3.2).

Which component is the largest, which scan is the reference, by which path every other one hangs on it, and which frame
the map gets. Triangles of registrations that close speak for each other; a path goes over those that do.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    dijkstra,
    minimum_spanning_tree,
)

from worker.cloud.poses import difference, fit_poses, inverse
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.mapping.pose_graph_optimization import Poses, optimize, residual
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.registration.scan_to_scan import PairResult

ENOUGH_PRIORS = 3  #: from which the error of one is outweighed
_HOP = 0.05  # cost of one more edge on a path
#: Times the limits of a loop: errors add up along the tree, and a wrong registration is metres off.
_PLAUSIBLE = 6.0
_LEVER = 2.0  # metres at which a prior's direction counts as much as its place


@dataclass(frozen=True, kw_only=True, slots=True)
class Chains:
    """Every scan of one component brought into the frame of its reference scan."""

    reference: int
    poses: dict[int, Matrix4]  #: reference_from_scan
    paths: dict[int, tuple[int, ...]]  #: from the reference to the scan, both named


def components(scans: Sequence[int], edges: Sequence[PairResult]) -> list[tuple[int, ...]]:
    """Return connected scans, the largest set first; of equal ones that with the lowest index."""
    _, labels = connected_components(_matrix(scans, edges, np.ones(len(edges))), directed=False)
    sets = defaultdict(list)
    for scan, label in zip(scans, labels, strict=True):
        sets[label].append(scan)
    return sorted(map(tuple, sets.values()), key=lambda members: (-len(members), members[0]))


def reference_of(scans: Sequence[int], edges: Sequence[PairResult]) -> int:
    """Return the scan of highest degree, of those the one of highest mean fitness."""
    fitness = defaultdict(list)
    for edge in edges:
        for scan in edge.pair:
            fitness[scan].append(edge.fitness)
    return max(scans, key=lambda scan: (len(fitness[scan]), np.mean(fitness[scan] or [0.0]), -scan))


def chain(scans: Sequence[int], edges: Sequence[PairResult], settings: MappingSettings) -> Chains:
    """Chain the registrations along shortest paths from the reference; an edge is short that can be relied on."""
    reference = reference_of(scans, edges)
    graph = _matrix(scans, edges, _HOP + _costs(edges, settings))
    _, before = dijkstra(graph, directed=False, indices=scans.index(reference), return_predecessors=True)
    return _follow(scans, edges, reference, before)


def most_reliable_tree(
    scans: Sequence[int], edges: Sequence[PairResult], settings: MappingSettings
) -> Chains:
    """Chain them along the tree of the edges that can be relied on most: a long way round a doubtful edge.

    Paths are long, and errors grow along them: good for telling which of the other edges may be true.
    """
    reference = reference_of(scans, edges)
    tree = minimum_spanning_tree(_matrix(scans, edges, 1e-9 + _costs(edges, settings)))
    _, before = breadth_first_order(tree, scans.index(reference), directed=False)
    return _follow(scans, edges, reference, before)


def _costs(edges: Sequence[PairResult], settings: MappingSettings) -> Floats:
    costs: Floats = -np.log(np.clip(reliability(edges, settings), 1e-6, 1.0))
    return costs


def _follow(
    scans: Sequence[int], edges: Sequence[PairResult], reference: int, before: NDArray[np.int32]
) -> Chains:
    """Chain poses and paths; `before` is the row before each scan's on the way from the reference."""
    parent_of = {scan: scans[int(row)] for scan, row in zip(scans, before, strict=True) if row >= 0}
    between = {edge.pair: edge.target_from_source for edge in edges}
    between |= {(edge.source, edge.target): inverse(edge.target_from_source) for edge in edges}
    paths: dict[int, tuple[int, ...]] = {reference: (reference,)}
    poses = {reference: np.eye(4)}
    for scan in scans:
        waiting = [scan]
        while waiting[-1] not in paths:
            waiting.append(parent_of[waiting[-1]])
        for parent, child in zip(waiting[:0:-1], waiting[-2::-1], strict=True):
            paths[child] = (*paths[parent], child)
            poses[child] = poses[parent] @ between[parent, child]
    return Chains(reference=reference, poses=poses, paths=paths)


def reliability(edges: Sequence[PairResult], settings: MappingSettings) -> Floats:
    """Return (E,) in 0..1: the confidence of each, times the share of triangles that close over it."""
    closing, open_ = triangle_counts(edges, settings)
    return np.array([edge.confidence for edge in edges]) * (closing + 1) / (closing + open_ + 2)


def triangle_counts(edges: Sequence[PairResult], settings: MappingSettings) -> tuple[Floats, Floats]:
    """Count (E,) the triangles over each edge that close within the limits of a loop, and that do not."""
    number_of = {frozenset(edge.pair): number for number, edge in enumerate(edges)}
    near = defaultdict(set)
    for edge in edges:
        near[edge.target].add(edge.source)
        near[edge.source].add(edge.target)
    closing, open_ = np.zeros(len(edges)), np.zeros(len(edges))
    for a, b, c in _triangles(near):
        members = [number_of[frozenset(pair)] for pair in ((a, b), (b, c), (a, c))]
        ab, bc, ac = (
            _directed(edges[number], target) for number, target in zip(members, (a, b, a), strict=True)
        )
        metres, radians = difference(ac, ab @ bc)
        closes = metres <= settings.loop_distance and radians <= settings.loop_angle
        (closing if closes else open_)[members] += 1
    return closing, open_


def _triangles(near: dict[int, set[int]]) -> list[tuple[int, int, int]]:
    return [
        (a, b, c)
        for a in sorted(near)
        for b in sorted(near[a])
        if b > a
        for c in sorted(near[a] & near[b])
        if c > b
    ]


def _directed(edge: PairResult, target: int) -> Matrix4:
    return edge.target_from_source if edge.target == target else inverse(edge.target_from_source)


def _matrix(scans: Sequence[int], edges: Sequence[PairResult], values: Floats) -> scipy.sparse.csr_array:
    row_of = {scan: row for row, scan in enumerate(scans)}
    ends = ([row_of[edge.target] for edge in edges], [row_of[edge.source] for edge in edges])
    return scipy.sparse.csr_array((values, ends), shape=(len(scans), len(scans)))


@dataclass(frozen=True, kw_only=True, slots=True)
class Solution:
    """The largest set of scans that registrations agree on, in the frame of its reference scan."""

    reference: int
    poses: dict[int, Matrix4]  #: reference_from_scan
    paths: dict[int, tuple[int, ...]]  #: from the reference to the scan, both named
    kept: tuple[PairResult, ...]  #: the registrations between these scans that agree
    elsewhere: tuple[PairResult, ...]  #: accepted ones between scans of smaller sets
    rejected: tuple[PairResult, ...]  #: accepted ones that loops do not close over


def solve_graph(scans: Sequence[int], pairs: Sequence[PairResult], settings: MappingSettings) -> Solution:
    """Chain the accepted registrations, optimise them robustly, reject what is far from the rest, and repeat.

    Ends when what is left is connected and agrees; a rejection takes at least one edge, so it does end.
    """
    edges = [pair for pair in pairs if pair.accepted]
    rejected: list[PairResult] = []
    while True:
        members = components(scans, edges)[0]
        inside = set(members)
        within = [edge for edge in edges if edge.target in inside]
        tree = most_reliable_tree(members, within, settings)
        chains = chain(members, _plausible(tree.poses, within, settings), settings)
        plausible = _plausible(chains.poses, within, settings)
        poses, _ = optimize(chains.poses, plausible, fixed=chains.reference, settings=settings)
        wrong = {id(edge) for edge in within if residual(poses, edge, settings) > 1}
        if not wrong:
            return Solution(
                reference=chains.reference,
                poses=poses,
                paths=chains.paths,
                kept=tuple(within),
                elsewhere=tuple(edge for edge in edges if edge.target not in inside),
                rejected=tuple(rejected),
            )
        rejected += [edge for edge in within if id(edge) in wrong]
        edges = [edge for edge in edges if id(edge) not in wrong]


def _plausible(poses: Poses, edges: Sequence[PairResult], settings: MappingSettings) -> list[PairResult]:
    """Return the edges that may be true by these poses."""
    return [edge for edge in edges if residual(poses, edge, settings) <= _PLAUSIBLE]


def map_from_reference(
    poses: Mapping[int, Matrix4], priors: Mapping[int, Matrix4], reference: int
) -> Matrix4:
    """Return the frame of the priors, from that of the reference scan.

    `poses` are reference_from_scan, `priors` map_from_scan as far as they are known. With three or more the motion of
    least squares to all, for one scan's heading may be degrees off; with fewer the reference's prior, else the first
    there is, else identity.
    """
    known = [scan for scan in poses if scan in priors]
    if not known:
        return np.eye(4)
    if len(known) < ENOUGH_PRIORS:
        scan = reference if reference in known else known[0]
        pose: Matrix4 = priors[scan] @ inverse(poses[scan])
        return pose
    return fit_poses([poses[scan] for scan in known], [priors[scan] for scan in known], arm=_LEVER)
