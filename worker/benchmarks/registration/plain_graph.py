"""The pose graph of the plain way: the largest component, and Open3D's global optimisation of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import open3d as o3d

from worker.cloud.types import Floats, Matrix4

_registration = o3d.pipelines.registration
GATE, PRUNE = 0.05, 0.25  # metres of Table 1, and Open3D's default share below which a loop counts as false


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlainEdge:
    """A pair that was accepted."""

    pair: tuple[int, int]  #: i, j: indices of the files, i < j
    i_from_j: Matrix4  #: (4, 4)
    information: Floats  #: (6, 6), as Open3D weighs edges
    fitness: float
    inlier_rmse: float  #: metres


def optimised(edges: Sequence[PlainEdge], priors: Sequence[Matrix4]) -> dict[int, Matrix4]:
    """map_from_scan of the largest component, from the priors on, in the frame of the one of most edges.

    Successive scans count as certain and all other edges as loops that may be false, as Open3D's own
    multiway registration has it.
    """
    members = _largest_component(edges, len(priors))
    node = {member: number for number, member in enumerate(members)}
    inside = [edge for edge in edges if edge.pair[0] in node]
    graph = _registration.PoseGraph()
    for member in members:
        graph.nodes.append(_registration.PoseGraphNode(priors[member]))
    for edge in inside:
        i, j = edge.pair  # Open3D's edge leads from its source j to its target i
        graph.edges.append(
            _registration.PoseGraphEdge(
                node[j], node[i], edge.i_from_j, edge.information, uncertain=j != i + 1
            )
        )
    degrees = [sum(member in edge.pair for edge in inside) for member in members]
    # it warns on stdout, which is for results, where successive scans alone do not hold the graph together
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        _registration.global_optimization(
            graph,
            _registration.GlobalOptimizationLevenbergMarquardt(),
            _registration.GlobalOptimizationConvergenceCriteria(),
            _registration.GlobalOptimizationOption(
                max_correspondence_distance=GATE,
                edge_prune_threshold=PRUNE,
                reference_node=degrees.index(max(degrees)),
            ),
        )
    return {member: graph.nodes[number].pose.copy() for member, number in node.items()}


def _largest_component(edges: Sequence[PlainEdge], count: int) -> list[int]:
    """Indices in order; of equal ones that with the lowest index."""
    component = list(range(count))
    for edge in edges:
        old, new = (component[end] for end in edge.pair)
        component = [new if each == old else each for each in component]
    most = max(component, key=component.count)
    return [at for at in range(count) if component[at] == most]
