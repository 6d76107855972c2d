"""What makes two honest observations of one tile differ (paper, Sections 3.5.3 and 3.8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from worker.cloud.types import Points
from worker.training.anomalies import nuisance_sigma


@dataclass(frozen=True, kw_only=True, slots=True)
class Augmentation:
    """Noise on each branch of each pair (paper, Section 3.8)."""

    jitter: float = 0.005  #: metres, of each point
    dropout: float = 0.05  #: share of points lost and replenished
    replenish_jitter: float = 0.002  #: metres, of a replenished point about its neighbour
    shift: float = 0.01  #: metres, of the whole patch along each axis
    yaw: float = math.radians(1.0)  #: radians, of the whole patch


@dataclass(frozen=True, kw_only=True, slots=True)
class Nuisance:
    """Differences of a second observation (paper, Section 3.5.3), at full intensity.

    The paper names no range for the yaw and the translation that both patches share; these are ours.
    """

    yaw: float = math.radians(15.0)  #: radians, either way, of both patches together
    shift: float = 0.05  #: metres, either way along each axis, of both patches together
    dropout: tuple[float, float] = (0.10, 0.50)  #: share of the second observation's points that are lost
    magnitude: tuple[float, float] = (0.10, 0.50)  #: metres, m in the residual shift's sigma 0.001 + 0.05 m


def augmented(patch: Points, settings: Augmentation, rng: np.random.Generator) -> Points:
    """Augment one branch, (N, 3) -> (N, 3), with sensor noise, lost points and a residual of registration."""
    thinned = replenished(patch, settings, rng)
    noisy = (thinned + rng.normal(scale=settings.jitter, size=thinned.shape)).astype(np.float32)
    turned = rotated(noisy, rng.normal(scale=settings.yaw))
    return (turned + rng.normal(scale=settings.shift, size=3)).astype(np.float32)


def replenished(patch: Points, settings: Augmentation, rng: np.random.Generator) -> Points:
    """Replace a share of the points (N, 3) by jittered copies of their nearest neighbours."""
    lost = rng.permutation(len(patch))[: round(settings.dropout * len(patch))]
    kept = np.delete(patch, lost, axis=0)
    if len(lost) == 0 or len(kept) == 0:
        return patch
    squares = (kept * kept).sum(axis=1)
    nearest = (squares - 2 * patch[lost] @ kept.T).argmin(axis=1)  # |a - b|^2 less the |a|^2 of its row
    filled = patch.copy()
    filled[lost] = kept[nearest] + rng.normal(scale=settings.replenish_jitter, size=(len(lost), 3))
    return filled


def second_observation(
    reference: Points, current: Points, settings: Nuisance, intensity: float, rng: np.random.Generator
) -> tuple[Points, Points]:
    """Turn and shift both dense tiles alike; the current one is thinned and a little off.

    The current tile keeps 64 points at least.
    """
    yaw = intensity * rng.uniform(-settings.yaw, settings.yaw)
    shift = intensity * rng.uniform(-settings.shift, settings.shift, size=3)
    lost = intensity * rng.uniform(*settings.dropout)
    residual = intensity * rng.normal(scale=nuisance_sigma(rng.uniform(*settings.magnitude)), size=3)
    kept = rng.permutation(len(current))[: max(round((1 - lost) * len(current)), min(64, len(current)))]
    return (
        (rotated(reference, yaw) + shift).astype(np.float32),
        (rotated(current[kept], yaw) + shift + residual).astype(np.float32),
    )


def turned_alike(reference: Points, current: Points, rng: np.random.Generator) -> tuple[Points, Points]:
    """Put both patches under one of the eight symmetries of a square tile: a room has no preferred corner."""
    turns, mirror = rng.integers(4), rng.integers(2)

    def turned(points: Points) -> Points:
        result = points * np.array([1 - 2 * mirror, 1, 1], dtype=np.float32)
        for _ in range(turns):
            result = result[:, [1, 0, 2]] * np.array([-1, 1, 1], dtype=np.float32)
        return result

    return turned(reference), turned(current)


def rotated(points: Points, yaw: float) -> Points:
    """Return (n, 3) about the vertical through the tile's centre, radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=np.float32)
    return points @ R.T
