"""Synthetic changes of a dense tile, made before farthest point sampling (paper, Sections 3.5.1 and 3.5.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.pipeline.values import Points

MIN_RETAINED = 64  #: points that a removal leaves
ADD_VERTICAL = 0.25  #: share of the vertical shift that is kept: indoor things stand beside each other
MOVE_VERTICAL = 0.3

Half = NDArray[np.float32]  #: (3,) metres, half the tile's size: the tile is -half..half


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """How large a change is."""

    magnitude: float  #: metres of displacement
    density: float  #: share of the tile's points that it touches


Operation = Callable[[Points, Change, Half, np.random.Generator], Points]


def add_object(points: Points, change: Change, half: Half, rng: np.random.Generator) -> Points:
    """(n, 3) -> (n + k, 3): the k points around a random one again, shifted and jittered, kept in the tile."""
    chosen = _cluster(points, change.density, rng)
    spread = rng.normal(scale=nuisance_sigma(change.magnitude), size=(len(chosen), 3))
    added = points[chosen] + _shift(change.magnitude, ADD_VERTICAL, rng) + spread
    return np.concatenate([points, np.clip(added, -half, half).astype(np.float32)])


def remove_object(points: Points, change: Change, half: Half, rng: np.random.Generator) -> Points:  # noqa: ARG001
    """(n, 3) -> (n - k, 3): the k points around a random one are gone, but never below 64 points."""
    chosen = _cluster(points, change.density, rng)
    chosen = chosen[: max(len(points) - MIN_RETAINED, 0)]
    return np.delete(points, chosen, axis=0)


def move_object(points: Points, change: Change, half: Half, rng: np.random.Generator) -> Points:
    """(n, 3) -> (n, 3): the k points around a random one are shifted as one, kept in the tile."""
    chosen = _cluster(points, change.density, rng)
    moved = points.copy()
    shifted = points[chosen] + _shift(change.magnitude, MOVE_VERTICAL, rng)
    moved[chosen] = np.clip(shifted, -half, half)
    return moved


OPERATIONS: dict[str, Operation] = {"add": add_object, "remove": remove_object, "move": move_object}


def nuisance_sigma(magnitude: float) -> float:
    """Metres; 0.001 + 0.05 m (paper, Sections 3.5.1 and 3.5.3)."""
    return 0.001 + 0.05 * magnitude


def _cluster(points: Points, density: float, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices (k,) of the k = d N points nearest to a random one, nearest first."""
    k = max(1, round(density * len(points)))
    centre = points[rng.integers(len(points))]
    distance = ((points - centre) ** 2).sum(axis=1)
    return np.argsort(distance, kind="stable")[:k]


def _shift(magnitude: float, vertical: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """(3,) metres: a random direction of the given length, then flattened."""
    direction = rng.normal(size=3)
    shift: NDArray[np.float64] = magnitude * direction / np.linalg.norm(direction)
    shift[2] *= vertical
    return shift
