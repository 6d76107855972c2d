"""Scans as nodes and registrations as edges, without any point: poses are known, registrations are made from them."""

from __future__ import annotations

import numpy as np

from worker.cloud.poses import exponential, inverse
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.registration.scan_to_scan import PairResult

#: of a pair: radians are known better than metres, as levers of some metres do it
INFORMATION = np.diag([4e4, 4e4, 4e4, 1e4, 1e4, 1e4])


def shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw: float = 0.0) -> Matrix4:
    """Metres and radians."""
    return exponential(np.array([0.0, 0.0, yaw, x, y, z]))


def ring(count: int, *, radius: float = 6.0) -> dict[int, Matrix4]:
    """map_from_scan of scans around a block, each looking ahead."""
    angles = 2 * np.pi * np.arange(count) / count
    return {
        number: shifted(radius * np.cos(angle), radius * np.sin(angle), 0.35, yaw=angle + np.pi / 2)
        for number, angle in enumerate(angles)
    }


def line(count: int, *, step: float = 2.0) -> dict[int, Matrix4]:
    """map_from_scan of scans along x, each turned a little more than the last."""
    return {number: shifted(step * number, yaw=0.1 * number) for number in range(count)}


def edge(
    truth: dict[int, Matrix4],
    target: int,
    source: int,
    *,
    error: Matrix4 | None = None,
    fitness: float = 0.8,
    two_way_inlier_ratio: float = 0.97,
    free_space_violation: float = 0.0,
    accepted: bool = True,
    information: Floats = INFORMATION,
) -> PairResult:
    """The registration that the true poses give, moved by `error` in the target's frame."""
    pose = inverse(truth[target]) @ truth[source]
    return PairResult(
        target=target,
        source=source,
        target_from_source=pose if error is None else error @ pose,
        fitness=fitness,
        inlier_rmse=0.025,
        overlap=0.7,
        two_way_inlier_ratio=two_way_inlier_ratio,
        free_space_violation=free_space_violation,
        consistent_with_prior=False,
        accepted=accepted,
        information=information,
    )


def small_errors(seed: int, *, metres: float = 0.005, radians: float = 0.001) -> Matrix4:
    """A draw of what ICP leaves."""
    rng = np.random.default_rng(seed)
    return exponential(np.r_[rng.normal(0, radians, 3), rng.normal(0, metres, 3)])


def around(truth: dict[int, Matrix4], *, reach: int = 2, noise: bool = True) -> list[PairResult]:
    """Each scan of a ring with the next `reach` ones."""
    count = len(truth)
    pairs = [(number, (number + hop) % count) for number in range(count) for hop in range(1, reach + 1)]
    return [
        edge(truth, min(pair), max(pair), error=small_errors(seed) if noise else None)
        for seed, pair in enumerate(pairs)
    ]


def along(truth: dict[int, Matrix4], *, reach: int = 2, noise: bool = True) -> list[PairResult]:
    """Each scan of a line with the next `reach` ones."""
    pairs = [(a, b) for a in truth for b in truth if a < b <= a + reach]
    return [
        edge(truth, a, b, error=small_errors(seed) if noise else None) for seed, (a, b) in enumerate(pairs)
    ]
