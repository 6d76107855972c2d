"""The plain way to a map: all pairs, Open3D's ICP from the priors, its pose graph, one process.

What the paper's Sections 3.3.2 and 3.3.3 need if nothing is culled and nothing runs in parallel; the measure
of what our way saves. With `PAPER_GATES` it is Table 1 to the letter, whose 5 cm cannot pull in a drift of
25 cm; with `COARSE_TO_FINE` it begins as wide as ours, so that it can end in the same poses.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import open3d as o3d

from worker.benchmarks.registration.plain_graph import PlainEdge, optimised
from worker.cloud.poses import inverse
from worker.cloud.types import Matrix4
from worker.pipeline.registration.results import ScanFile
from worker.progress import Progress, no_progress

PAPER_GATES = (0.05,)
COARSE_TO_FINE = (0.6, 0.3, 0.1, 0.05)
VOXEL, NORMAL_RADIUS, NORMAL_NEIGHBORS = 0.05, 0.10, 30  # Table 1
MIN_FITNESS, MAX_RMSE = 0.55, 0.05  # Table 1

Pair = tuple[int, int]  #: indices of two files, the lower first

_registration = o3d.pipelines.registration


@dataclass(frozen=True, kw_only=True, slots=True)
class PlainSettings:
    """How plain."""

    gates: tuple[float, ...] = COARSE_TO_FINE  #: metres, one ICP after the other
    sample: int | None = None  #: so many pairs at random instead of all; `always` are run in any case
    always: frozenset[Pair] = frozenset()
    seed: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlainMap:
    """What came of it."""

    poses: dict[int, Matrix4]  #: map_from_scan by index of the file; the largest component alone
    edges: tuple[PlainEdge, ...]  #: pairs that were accepted
    pairs_possible: int
    pairs_run: int
    points: int  #: of the fused map
    seconds: dict[str, float] = field(default_factory=dict)  #: by stage; `pairs` as if all had been run


def build_plainly(
    files: Sequence[ScanFile], settings: PlainSettings, progress: Progress = no_progress
) -> PlainMap:
    """Every stage once, timed. Raises ScanError for a file that cannot be read, ValueError for one without a prior."""
    priors = [file.pose for file in files if file.pose is not None]
    if len(priors) < len(files):
        raise ValueError("the plain way begins at pose priors; some files have none")
    clouds, read = _prepared(files, progress)
    runs, seconds = _registered(priors, clouds, settings, progress)
    edges = tuple(edge for edge in runs if edge is not None)
    begun = time.perf_counter()
    poses = optimised(edges, priors)
    refined = time.perf_counter()
    points = _fused(files, poses)
    return PlainMap(
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


def chosen_pairs(count: int, settings: PlainSettings) -> tuple[list[Pair], list[Pair]]:
    """Pairs that are run in any case, and those of the rest that are (all, or a random sample)."""
    rest = [pair for pair in combinations(range(count), 2) if pair not in settings.always]
    if settings.sample is not None and settings.sample < len(rest):
        picked = np.random.default_rng(settings.seed).choice(len(rest), settings.sample, replace=False)
        rest = [rest[at] for at in sorted(picked)]
    return sorted(settings.always), rest


def _prepared(files: Sequence[ScanFile], progress: Progress) -> tuple[list[o3d.geometry.PointCloud], float]:
    begun, clouds = time.perf_counter(), []
    for number, file in enumerate(files):
        progress("plain way: voxels and normals", number / len(files))
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
    settings: PlainSettings,
    progress: Progress,
) -> tuple[list[PlainEdge | None], float]:
    """Each pair's edge, None where it was refused; and the seconds that all pairs take."""
    always, rest = chosen_pairs(len(clouds), settings)
    possible = len(clouds) * (len(clouds) - 1) // 2
    edges, spent = [], {True: 0.0, False: 0.0}
    for number, pair in enumerate([*always, *rest]):
        progress("plain way: pairs", number / (len(always) + len(rest)))
        begun = time.perf_counter()
        edges.append(_edge(pair, priors, clouds, settings.gates))
        spent[pair in settings.always] += time.perf_counter() - begun
    # the sample stands for what was left out, the pairs run in any case for themselves alone
    scale = (possible - len(always)) / max(len(rest), 1)
    return edges, spent[True] + spent[False] * scale


def _edge(
    pair: Pair,
    priors: Sequence[Matrix4],
    clouds: Sequence[o3d.geometry.PointCloud],
    gates: Sequence[float],
) -> PlainEdge | None:
    """Pair (i, j): scan j registered to scan i from where their priors have it."""
    target, source = (clouds[at] for at in pair)
    pose = inverse(priors[pair[0]]) @ priors[pair[1]]
    point_to_plane = _registration.TransformationEstimationPointToPlane()
    for gate in gates:
        found = _registration.registration_icp(source, target, gate, pose, point_to_plane)
        pose = found.transformation
    if found.fitness <= MIN_FITNESS or found.inlier_rmse >= MAX_RMSE:
        return None
    information = _registration.get_information_matrix_from_point_clouds(source, target, gates[-1], pose)
    return PlainEdge(
        pair=pair,
        i_from_j=np.asarray(pose),
        information=np.asarray(information),
        fitness=found.fitness,
        inlier_rmse=found.inlier_rmse,
    )


def _fused(files: Sequence[ScanFile], poses: dict[int, Matrix4]) -> int:
    """Points of the fused map."""
    fused = o3d.geometry.PointCloud()
    for at, pose in poses.items():
        cloud = _cloud(files[at])
        cloud.transform(pose)
        fused += cloud
    return len(fused.voxel_down_sample(VOXEL).points)
