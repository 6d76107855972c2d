from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.blocks import blocks_of


@pytest.mark.parametrize("most", [50, 400, 5000])
def test_each_point_is_own_to_one_block_which_has_all_that_lies_around_it(most: int) -> None:
    points = np.random.default_rng(1).uniform([0, 0, 0], [30, 8, 3], (3000, 3)).astype(np.float32)
    owned = np.zeros(len(points), int)
    for block in blocks_of(points, most=most, reach=0.7):
        own = block.rows[block.own]
        owned[own] += 1
        assert len(own) <= most
        apart = np.linalg.norm(points[own][:, None] - points[None], axis=2).min(axis=0)
        assert set(np.flatnonzero(apart < 0.7)) <= set(block.rows.tolist())
    assert (owned == 1).all()


def test_points_in_one_place_are_one_block_however_many_they_are() -> None:
    (block,) = blocks_of(np.ones((500, 3)), most=20, reach=1.0)
    assert len(block.own) == 500


def test_a_cloud_without_a_point_is_a_block_without_one() -> None:
    (block,) = blocks_of(np.empty((0, 3)), most=20, reach=1.0)
    assert not len(block.rows)
