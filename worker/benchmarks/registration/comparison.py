"""The plain way's map beside ours, from the same scans: the same relative poses, and in how many seconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from worker.benchmarks.registration.alignment import WRONG, align
from worker.benchmarks.registration.plain import PlainMap
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4

Poses = Mapping[int, Matrix4]  #: map_from_scan by index of the file


def compare(
    plain: PlainMap, ours: Poses, our_pairs: frozenset[tuple[int, int]], true: Sequence[Matrix4]
) -> dict[str, Any]:
    """Relative poses of the pairs that both ways accepted, and how each lies to the truth; JSON-ready.

    `our_pairs` are the pairs (lower index first) that our pose graph kept, `true` the world_from_sensor of all.
    """
    registered = {edge.pair: edge.i_from_j for edge in plain.edges}
    common = sorted(set(registered) & our_pairs)
    apart = [difference(relative(ours, pair), registered[pair]) for pair in common]
    right = [pair for pair in registered if not _wrong(registered[pair], true, pair)]
    return {
        "pairs_possible": plain.pairs_possible,
        "pairs_run": plain.pairs_run,
        "accepted": len(plain.poses),
        "pairs_accepted": len(registered),
        "pairs_wrong": len(registered) - len(right),
        "our_pairs": len(our_pairs),
        "our_pairs_wrong": sum(_wrong(relative(ours, pair), true, pair) for pair in our_pairs),
        "common": spread(apart),
        "common_right": spread([apart[common.index(pair)] for pair in right if pair in our_pairs]),
        "to_the_truth": to_the_truth(plain.poses, true),
        "seconds": {**plain.seconds, "total": sum(plain.seconds.values())},
        "map_points": plain.points,
    }


def relative(poses: Poses, pair: tuple[int, int]) -> Matrix4:
    """i_from_j."""
    between: Matrix4 = inverse(poses[pair[0]]) @ poses[pair[1]]
    return between


def spread(apart: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Metres and radians apart: how many, and the median and 95 % of them in centimetres and degrees."""
    if not apart:
        return {"pairs": 0}
    centimetres, degrees = 100 * np.array(apart)[:, 0], np.degrees(np.array(apart)[:, 1])
    return {
        "pairs": len(apart),
        "centimetres": {
            "median": float(np.median(centimetres)),
            "95%": float(np.percentile(centimetres, 95)),
        },
        "degrees": {"median": float(np.median(degrees)), "95%": float(np.percentile(degrees, 95))},
    }


def to_the_truth(poses: Poses, true: Sequence[Matrix4]) -> dict[str, Any]:
    """As the table of our own map has it; centimetres and degrees."""
    members = sorted(poses)
    there = [true[member] for member in members]
    frame = align([poses[member] for member in members], there)
    off = [difference(pose, frame @ poses[member]) for member, pose in zip(members, there, strict=True)]
    metres, radians = np.array(off).T
    return {
        "wrong": int(np.sum(metres > WRONG)),
        "centimetres": {"median": float(100 * np.median(metres)), "worst": float(100 * metres.max())},
        "degrees": {
            "median": float(np.degrees(np.median(radians))),
            "worst": float(np.degrees(radians.max())),
        },
    }


def _wrong(i_from_j: Matrix4, true: Sequence[Matrix4], pair: tuple[int, int]) -> bool:
    return difference(inverse(true[pair[0]]) @ true[pair[1]], i_from_j)[0] > WRONG
