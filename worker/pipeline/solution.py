"""From registrations to one pose a scan: component, reference, chains, and the vote on what contradicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from worker.pipeline.map_settings import MapSettings
from worker.pipeline.optimisation import Poses, optimised, residual
from worker.pipeline.pairwise import PairResult
from worker.pipeline.pose_graph import chained, components, most_reliable_tree
from worker.pipeline.values import Matrix4

#: Times the limits of a loop: errors add up along the tree, and a wrong registration is metres off.
_PLAUSIBLE = 6.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Solution:
    """The largest set of scans that registrations agree on, in the frame of its reference scan."""

    reference: int
    poses: dict[int, Matrix4]  #: reference_from_scan
    paths: dict[int, tuple[int, ...]]  #: from the reference to the scan, both named
    kept: tuple[PairResult, ...]  #: the registrations between these scans that agree
    elsewhere: tuple[PairResult, ...]  #: accepted ones between scans of smaller sets
    contradicted: tuple[PairResult, ...]  #: accepted ones that loops do not close over


def solve_graph(scans: Sequence[int], pairs: Sequence[PairResult], settings: MapSettings) -> Solution:
    """Chain the accepted registrations, optimise them robustly, throw out what is far from the rest, and repeat.

    Ends when what is left is connected and agrees; a throw takes at least one edge, so it does end.
    """
    edges = [pair for pair in pairs if pair.accepted]
    contradicted: list[PairResult] = []
    while True:
        members = components(scans, edges)[0]
        inside = set(members)
        within = [edge for edge in edges if edge.target in inside]
        chains = chained(members, _plausible(members, within, settings), settings)
        poses, _ = optimised(
            chains.poses, _agreeing(chains.poses, within, settings), fixed=chains.reference, settings=settings
        )
        wrong = {id(edge) for edge in within if residual(poses, edge, settings) > 1}
        if not wrong:
            return Solution(
                reference=chains.reference,
                poses=poses,
                paths=chains.paths,
                kept=tuple(within),
                elsewhere=tuple(edge for edge in edges if edge.target not in inside),
                contradicted=tuple(contradicted),
            )
        contradicted += [edge for edge in within if id(edge) in wrong]
        edges = [edge for edge in edges if id(edge) not in wrong]


def _plausible(
    members: Sequence[int], edges: Sequence[PairResult], settings: MapSettings
) -> list[PairResult]:
    """What may be true by the edges that can be relied on most."""
    return _agreeing(most_reliable_tree(members, edges, settings).poses, edges, settings)


def _agreeing(poses: Poses, edges: Sequence[PairResult], settings: MapSettings) -> list[PairResult]:
    return [edge for edge in edges if residual(poses, edge, settings) <= _PLAUSIBLE]
