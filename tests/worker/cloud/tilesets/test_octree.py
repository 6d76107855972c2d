"""Places along the Morton curve, and samples that are nested."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.tilesets.octree import BITS, DEEPEST, GRID_BITS, Cube, node_of, samples


@pytest.fixture
def codes() -> np.ndarray:
    points = np.random.default_rng(0).uniform(0, 8, (20_000, 3)).astype(np.float32)
    points[:, 2] = 0.5
    return np.sort(Cube(lower=np.zeros(3), side=8.0).codes(points))


def test_nodes_are_the_eight_children_in_the_order_x_y_z() -> None:
    cube = Cube(lower=np.array([10.0, 0, 0]), side=4.0)
    corners = [(x, y, z) for z in (1, 3) for y in (1, 3) for x in (11, 13)]
    assert node_of(cube.codes(np.array(corners, np.float32)), 1).tolist() == list(range(8))


def test_points_on_the_far_side_and_beyond_are_in_the_last_cell() -> None:
    cube = Cube(lower=np.zeros(3), side=1.0)
    last = cube.codes(np.array([[1, 1, 1], [1.5, 2, 3]], np.float32))
    assert last.tolist() == [(1 << 3 * BITS) - 1] * 2


def test_every_cell_that_holds_a_point_has_one_sample(codes: np.ndarray) -> None:
    for level in range(4):
        cells = codes >> np.uint64(3 * (BITS - GRID_BITS - level))
        chosen = cells[samples(codes, level)]
        assert chosen.tolist() == np.unique(cells).tolist()


def test_the_samples_of_a_level_are_among_those_of_the_next(codes: np.ndarray) -> None:
    for level in range(DEEPEST):
        assert not (samples(codes, level) & ~samples(codes, level + 1)).any()


def test_samples_of_samples_are_those_of_all(codes: np.ndarray) -> None:
    """So a node may be made of what its children's samples are, without their points."""
    finer = samples(codes, 3)
    assert codes[finer][samples(codes[finer], 1)].tolist() == codes[samples(codes, 1)].tolist()


def test_samples_lie_anywhere_in_their_cells() -> None:
    """Not at a corner, as the first or the last of each cell would."""
    points = np.random.default_rng(0).uniform(0, 8, (200_000, 3)).astype(np.float32)
    points[:, 2] = 0.5
    codes = Cube(lower=np.zeros(3), side=8.0).codes(points)
    order = np.argsort(codes)
    chosen = points[order][samples(codes[order], 0)]
    within = chosen[:, :2] / (8 / 64) % 1
    assert within.mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.03)
    assert within.std(axis=0) == pytest.approx([12**-0.5] * 2, abs=0.03)
