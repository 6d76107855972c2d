"""The Open3D baseline: all pairs, its ICP from the priors, its pose graph, one process; and its map beside ours.

What the paper's Sections 3.3.2 and 3.3.3 need if nothing is culled and nothing runs in parallel; the measure
of what our way saves. With `PAPER_DISTANCES` it is Table 1 to the letter, whose 5 cm cannot pull in a drift of
25 cm; with `COARSE_TO_FINE` it begins as wide as ours, so that it can end in the same poses.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import open3d as o3d

from worker.benchmarks.documents import Document, pose_spread
from worker.benchmarks.trajectory import WRONG, align
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.registration.results import ScanFile
from worker.progress import Progress, no_progress

PAPER_DISTANCES = (0.05,)  #: metres, of correspondences
COARSE_TO_FINE = (0.6, 0.3, 0.1, 0.05)
VOXEL, NORMAL_RADIUS, NORMAL_NEIGHBORS = 0.05, 0.10, 30  # Table 1
MIN_FITNESS, MAX_RMSE = 0.55, 0.05  # Table 1
GRAPH_DISTANCE = 0.05  # metres, Table 1
PRUNE = 0.25  # Open3D's default share, below which a loop counts as false

Pair = tuple[int, int]  #: indices of two files, the lower first
Poses = Mapping[int, Matrix4]  #: map_from_scan by index of the file

_registration = o3d.pipelines.registration


@dataclass(frozen=True, kw_only=True, slots=True)
class BaselineSettings:
    """What is run of it."""

    distances: tuple[float, ...] = COARSE_TO_FINE  #: metres of correspondences, one ICP after the other
    sample: int | None = None  #: so many pairs at random instead of all; `always` are run in any case
    always: frozenset[Pair] = frozenset()
    seed: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class BaselineEdge:
    """A pair that was accepted."""

    pair: Pair
    i_from_j: Matrix4  #: (4, 4)
    information: Floats  #: (6, 6), as Open3D weighs edges


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class BaselineMap:
    """The map that it makes."""

    poses: dict[int, Matrix4]  #: map_from_scan by index of the file; the largest component alone
    edges: tuple[BaselineEdge, ...]  #: pairs that were accepted
    pairs_possible: int
    pairs_run: int
    points: int  #: of the fused map
    seconds: dict[str, float] = field(default_factory=dict)  #: by stage; `pairs` as if all had been run


def build_baseline(
    files: Sequence[ScanFile], settings: BaselineSettings, progress: Progress = no_progress
) -> BaselineMap:
    """Run every stage once, timed. Raises ScanError for an unreadable file, ValueError for one without a prior."""
    priors = [file.pose for file in files if file.pose is not None]
    if len(priors) < len(files):
        raise ValueError("the baseline begins at pose priors; some files have none")
    clouds, read = _prepared(files, progress)
    runs, seconds = _registered(priors, clouds, settings, progress)
    edges = tuple(edge for edge in runs if edge is not None)
    begun = time.perf_counter()
    poses = optimised(edges, priors)
    refined = time.perf_counter()
    points = _fused(files, poses)
    return BaselineMap(
        poses=poses,
        edges=edges,
        pairs_possible=len(files) * (len(files) - 1) // 2,
        pairs_run=len(runs),
        points=points,
        seconds={
            "read, voxels, normals": read,
            "pairs": seconds,
            "pose graph": refined - begun,
            "fusion": time.perf_counter() - refined,
        },
    )


def chosen_pairs(count: int, settings: BaselineSettings) -> tuple[list[Pair], list[Pair]]:
    """List the pairs that are run in any case, and those of the rest that are (all, or a random sample)."""
    rest = [pair for pair in combinations(range(count), 2) if pair not in settings.always]
    if settings.sample is not None and settings.sample < len(rest):
        picked = np.random.default_rng(settings.seed).choice(len(rest), settings.sample, replace=False)
        rest = [rest[number] for number in sorted(picked)]
    return sorted(settings.always), rest


def _prepared(files: Sequence[ScanFile], progress: Progress) -> tuple[list[o3d.geometry.PointCloud], float]:
    begun, clouds = time.perf_counter(), []
    for number, file in enumerate(files):
        progress("baseline: voxels and normals", number / len(files))
        cloud = _cloud(file).voxel_down_sample(VOXEL)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS, NORMAL_NEIGHBORS))
        clouds.append(cloud)
    return clouds, time.perf_counter() - begun


def _cloud(file: ScanFile) -> o3d.geometry.PointCloud:
    points = file.read(max_points=50_000_000).points
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))


def _registered(
    priors: Sequence[Matrix4],
    clouds: Sequence[o3d.geometry.PointCloud],
    settings: BaselineSettings,
    progress: Progress,
) -> tuple[list[BaselineEdge | None], float]:
    """Return each pair's edge, None where it was refused; and the seconds that all pairs take."""
    always, rest = chosen_pairs(len(clouds), settings)
    possible = len(clouds) * (len(clouds) - 1) // 2
    edges, spent = [], {True: 0.0, False: 0.0}
    for number, pair in enumerate([*always, *rest]):
        progress("baseline: pairs", number / (len(always) + len(rest)))
        begun = time.perf_counter()
        edges.append(_edge(pair, priors, clouds, settings.distances))
        spent[pair in settings.always] += time.perf_counter() - begun
    # the sample stands for what was left out, the pairs run in any case for themselves alone
    scale = (possible - len(always)) / max(len(rest), 1)
    return edges, spent[True] + spent[False] * scale


def _edge(
    pair: Pair,
    priors: Sequence[Matrix4],
    clouds: Sequence[o3d.geometry.PointCloud],
    distances: Sequence[float],
) -> BaselineEdge | None:
    """Register scan j of a pair (i, j) to scan i from where their priors have it."""
    target, source = (clouds[scan] for scan in pair)
    pose = inverse(priors[pair[0]]) @ priors[pair[1]]
    point_to_plane = _registration.TransformationEstimationPointToPlane()
    for distance in distances:
        result = _registration.registration_icp(source, target, distance, pose, point_to_plane)
        pose = result.transformation
    if result.fitness <= MIN_FITNESS or result.inlier_rmse >= MAX_RMSE:
        return None
    information = _registration.get_information_matrix_from_point_clouds(source, target, distances[-1], pose)
    return BaselineEdge(pair=pair, i_from_j=np.asarray(pose), information=np.asarray(information))


def _fused(files: Sequence[ScanFile], poses: dict[int, Matrix4]) -> int:
    """Count the points of the fused map."""
    fused = o3d.geometry.PointCloud()
    for scan, pose in poses.items():
        cloud = _cloud(files[scan])
        cloud.transform(pose)
        fused += cloud
    return len(fused.voxel_down_sample(VOXEL).points)


def optimised(edges: Sequence[BaselineEdge], priors: Sequence[Matrix4]) -> dict[int, Matrix4]:
    """Optimise map_from_scan of the largest component, from the priors on, in the frame of the one of most edges.

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
                max_correspondence_distance=GRAPH_DISTANCE,
                edge_prune_threshold=PRUNE,
                reference_node=degrees.index(max(degrees)),
            ),
        )
    return {member: graph.nodes[number].pose.copy() for member, number in node.items()}


def _largest_component(edges: Sequence[BaselineEdge], count: int) -> list[int]:
    """List its members in order; of equal components that with the lowest index."""
    component = list(range(count))
    for edge in edges:
        old, new = (component[end] for end in edge.pair)
        component = [new if member == old else member for member in component]
    most = max(component, key=component.count)
    return [member for member in range(count) if component[member] == most]


def compare(
    baseline: BaselineMap, ours: Poses, our_pairs: frozenset[Pair], true: Sequence[Matrix4]
) -> Document:
    """Compare relative poses of the pairs that both accepted, and how each lies to the truth; JSON-ready.

    `our_pairs` are the pairs (lower index first) that our pose graph kept, `true` the world_from_sensor of all.
    """
    registered = {edge.pair: edge.i_from_j for edge in baseline.edges}
    common = sorted(set(registered) & our_pairs)
    apart = {pair: difference(_relative(ours, pair), registered[pair]) for pair in common}
    right = [pair for pair in registered if not _wrong(registered[pair], true, pair)]
    return {
        "pairs_possible": baseline.pairs_possible,
        "pairs_run": baseline.pairs_run,
        "accepted": len(baseline.poses),
        "pairs_accepted": len(registered),
        "pairs_wrong": len(registered) - len(right),
        "our_pairs": len(our_pairs),
        "our_pairs_wrong": sum(_wrong(_relative(ours, pair), true, pair) for pair in our_pairs),
        "common": _apart(list(apart.values())),
        "common_right": _apart([apart[pair] for pair in right if pair in apart]),
        "to_the_truth": _to_the_truth(baseline.poses, true),
        "seconds": {**baseline.seconds, "total": sum(baseline.seconds.values())},
        "map_points": baseline.points,
    }


def _relative(poses: Poses, pair: Pair) -> Matrix4:
    """Return i_from_j."""
    between: Matrix4 = inverse(poses[pair[0]]) @ poses[pair[1]]
    return between


def _apart(differences: Sequence[tuple[float, float]]) -> Document:
    """Say how many pairs there are, and how far apart both ways put them."""
    if not differences:
        return {"pairs": 0}
    return {"pairs": len(differences), **pose_spread(differences, "median", "95%")}


def _to_the_truth(poses: Poses, true: Sequence[Matrix4]) -> Document:
    """Compare a map with the truth as the table of our own map does; centimetres and degrees."""
    frame = align(list(poses.values()), [true[scan] for scan in poses])
    off = [difference(true[scan], frame @ pose) for scan, pose in poses.items()]
    return {"wrong": sum(metres > WRONG for metres, _ in off), **pose_spread(off, "median", "worst")}


def _wrong(i_from_j: Matrix4, true: Sequence[Matrix4], pair: Pair) -> bool:
    return difference(inverse(true[pair[0]]) @ true[pair[1]], i_from_j)[0] > WRONG
