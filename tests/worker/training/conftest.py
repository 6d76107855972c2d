"""Tiles that need no simulator: a floor, a wall and a box each, seen twice with noise of its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from worker.training.dataset import Observation, TileSet

HALF = np.array([0.75, 0.75, 0.5], dtype=np.float32)


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Threads of small products wait for each other longer than they work, above all on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def seen(kind: int, rng: np.random.Generator) -> np.ndarray:
    """About 240 points of one of four places."""
    floor = np.c_[rng.uniform(-0.75, 0.75, (120, 2)), np.full(120, -0.5)]
    wall = np.c_[rng.uniform(-0.75, 0.75, 80), np.full(80, 0.7), rng.uniform(-0.5, 0.5, 80)]
    middle = np.array([0.5 * np.cos(kind), 0.4 * np.sin(kind), -0.3])
    box = middle + rng.uniform(-0.15, 0.15, (40, 3))
    parts = {0: (floor, wall, box), 1: (floor, box), 2: (wall, box), 3: (wall[:, [1, 0, 2]], floor)}[kind % 4]
    points = np.concatenate(parts) + rng.normal(scale=0.005, size=(sum(map(len, parts)), 3))
    return np.clip(points, -HALF, HALF).astype(np.float32)


def further(count: int, rng: np.random.Generator) -> Iterator[Observation]:
    """Of every other tile one with a second box in it, of the rest another honest one; rebuilt ones of each kind."""
    for kind in range(count):
        box = np.array([-0.3, 0.3, -0.2]) + rng.uniform(-0.15, 0.15, (60, 3))
        changed = kind % 2 == 0
        points = np.concatenate([seen(kind, rng), box.astype(np.float32)]) if changed else seen(kind, rng)
        yield Observation(tile=kind, points=points, changed=changed, rebuilt=kind % 4 >= 2)


@pytest.fixture(scope="session")
def tiles() -> TileSet:
    """Two buildings of 4 x 5 tiles each."""
    rng = np.random.default_rng(11)
    count = 40
    place = np.arange(count) % 20
    return TileSet(
        points_a=tuple(seen(kind, rng) for kind in range(count)),
        points_b=tuple(seen(kind, rng) for kind in range(count)),
        observations=tuple(further(count, rng)),
        centres=np.c_[1.5 * (place % 5), 1.5 * (place // 5), np.full(count, 0.5)],
        buildings=(np.arange(count) // 20).astype(np.int32),
        tile_size=(1.5, 1.5, 1.0),
        source="for tests",
    )
