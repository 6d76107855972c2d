"""Synthetic changes of a dense tile, made before farthest point sampling (paper, Sections 3.5.1 and 3.5.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Points

MIN_RETAINED = 64  #: points that a removal leaves
ADD_VERTICAL = 0.25  #: share of the vertical shift that is kept: indoor things stand beside each other
MOVE_VERTICAL = 0.3

Half = NDArray[np.float32]  #: (3,) metres, half the tile's size: the tile is -half..half


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangeSize:
    """How large a change is."""

    magnitude: float  #: metres of displacement
    density: float  #: share of the tile's points that it touches


@dataclass(frozen=True, kw_only=True, slots=True)
class Changed:
    """A tile after a change."""

    points: Points  #: (n, 3) metres, tile-centre frame
    appeared: Points  #: (a, 3) those of `points` that were not there
    vanished: Points  #: (v, 3) those that are there no more


Operation = Callable[[Points, ChangeSize, Half, np.random.Generator], Changed]


def add_object(points: Points, change: ChangeSize, half: Half, rng: np.random.Generator) -> Changed:
    """Add to (n, 3) the k points around a random one again, shifted and jittered, kept in the tile."""
    chosen = _cluster(points, change.density, rng)
    spread = rng.normal(scale=nuisance_sigma(change.magnitude), size=(len(chosen), 3))
    shifted = points[chosen] + _shift(change.magnitude, ADD_VERTICAL, rng) + spread
    added = np.clip(shifted, -half, half).astype(np.float32)
    return Changed(points=np.concatenate([points, added]), appeared=added, vanished=points[:0])


def remove_object(points: Points, change: ChangeSize, half: Half, rng: np.random.Generator) -> Changed:  # noqa: ARG001
    """Remove from (n, 3) the k points around a random one, but leave 64 points."""
    chosen = _cluster(points, change.density, rng)
    chosen = chosen[: max(len(points) - MIN_RETAINED, 0)]
    kept = np.delete(points, chosen, axis=0)
    return Changed(points=kept, appeared=points[:0], vanished=points[chosen])


def move_object(points: Points, change: ChangeSize, half: Half, rng: np.random.Generator) -> Changed:
    """Shift the k points of (n, 3) around a random one as one, kept in the tile."""
    chosen = _cluster(points, change.density, rng)
    moved = points.copy()
    shifted = points[chosen] + _shift(change.magnitude, MOVE_VERTICAL, rng)
    moved[chosen] = np.clip(shifted, -half, half)
    return Changed(points=moved, appeared=moved[chosen], vanished=points[chosen])


OPERATIONS: dict[str, Operation] = {"add": add_object, "remove": remove_object, "move": move_object}


def shown(before: Points, after: Changed, distance: float) -> int:
    """Return how many points of a change lie farther than `distance` (metres) from every point of the other cloud.

    A piece of floor doubled a little beside itself is floor as before: of such a change, nothing shows.
    """
    return _far(after.appeared, before, distance) + _far(after.vanished, after.points, distance)


def nuisance_sigma(magnitude: float) -> float:
    """Return metres, 0.001 + 0.05 m (paper, Sections 3.5.1 and 3.5.3)."""
    return 0.001 + 0.05 * magnitude


def _far(points: Points, others: Points, distance: float) -> int:
    squares = (others * others).sum(axis=1) - 2 * points @ others.T  # |a - b|^2 less the |a|^2 of its row
    nearest = squares.min(axis=1, initial=np.inf) + (points * points).sum(axis=1)
    return int((nearest > distance**2).sum())


def _cluster(points: Points, density: float, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return indices (k,) of the k = d N points nearest to a random one, nearest first."""
    k = max(1, round(density * len(points)))
    centre = points[rng.integers(len(points))]
    distance = ((points - centre) ** 2).sum(axis=1)
    return np.argsort(distance, kind="stable")[:k]


def _shift(magnitude: float, vertical: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return (3,) metres: a random direction of the given length, then flattened."""
    direction = rng.normal(size=3)
    shift: NDArray[np.float64] = magnitude * direction / np.linalg.norm(direction)
    shift[2] *= vertical
    return shift
