"""Packed voxel keys, held against plain sets of cells."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.voxel_keys import (
    BITS,
    blocks,
    centers,
    dilated,
    near,
    offsets,
    packed,
    regions,
    rows_of,
    union,
    unpacked,
)
from worker.cloud.voxels import Voxels


def some_cells(count: int, seed: int = 0) -> np.ndarray:
    return np.unique(np.random.default_rng(seed).integers(-6, 6, (count, 3)), axis=0)


def test_keys_hold_the_cells_and_sort_as_they_do() -> None:
    cells = some_cells(200)  # np.unique sorts rows by x, then y, then z
    keys = packed(cells)
    assert (np.diff(keys) > 0).all()
    assert np.array_equal(unpacked(keys), cells)


def test_the_farthest_cells_there_are_come_back() -> None:
    cells = np.array([[-(1 << (BITS - 1))] * 3, [(1 << (BITS - 1)) - 1] * 3])
    assert np.array_equal(unpacked(packed(cells)), cells)


def test_they_are_the_keys_of_fused_voxels() -> None:
    points = np.random.default_rng(1).uniform(-2, 2, (100, 3))
    keys = Voxels.keys_of(points, size=0.05)
    assert np.array_equal(keys, packed(np.floor(points / 0.05).astype(int)))
    assert np.abs(centers(keys, 0.05) - points).max() <= 0.025 + 1e-9


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_near_is_what_lies_within_so_many_voxels_along_each_axis(reach: int) -> None:
    ours, theirs = some_cells(150, seed=2), some_cells(40, seed=3)
    apart = np.abs(ours[:, None] - theirs[None]).max(axis=2).min(axis=1)
    assert np.array_equal(near(packed(ours), packed(theirs), reach), apart <= reach)


def test_near_reaches_over_the_ends_of_words_of_64_voxels() -> None:
    ours = np.array([[0, 0, z] for z in range(-70, 140)])
    theirs = np.array([[0, 0, -1], [0, 0, 63], [1, 0, 128], [0, 0, -64]])
    for reach in (1, 2):
        apart = np.abs(ours[:, None] - theirs[None]).max(axis=2).min(axis=1)
        order = np.argsort(packed(theirs))
        assert np.array_equal(near(packed(ours), packed(theirs)[order], reach), apart <= reach)


def test_nothing_is_near_to_nothing() -> None:
    assert not near(packed(some_cells(5)), np.empty(0, np.int64)).any()


def test_rows_are_found_and_the_missing_are_told() -> None:
    cells = some_cells(50)
    keys = packed(cells)
    assert rows_of(keys[[7, 3]], keys).tolist() == [7, 3]
    assert rows_of(packed(np.array([[99, 0, 0]])), keys).tolist() == [-1]
    assert rows_of(keys[:2], np.empty(0, np.int64)).tolist() == [-1, -1]


@pytest.mark.parametrize("levels", [1, 2])
def test_a_block_holds_two_to_the_power_of_levels_voxels_along_each_axis(levels: int) -> None:
    keys = packed(some_cells(300))
    cells = unpacked(keys) + (1 << (BITS - 1))
    expected = np.unique(cells >> levels, axis=0, return_inverse=True)[1]
    told = np.unique(blocks(keys, levels), return_inverse=True)[1]
    assert np.array_equal(told, expected.ravel())


def test_a_union_says_where_both_went() -> None:
    one, other = packed(some_cells(80, seed=4)), packed(some_cells(90, seed=5))
    both, ours, theirs = union(one, other)
    assert np.array_equal(both, np.union1d(one, other))
    assert np.array_equal(both[ours], one)
    assert np.array_equal(both[theirs], other)
    nothing = np.empty(0, np.int64)
    assert len(union(nothing, nothing)[0]) == 0
    assert np.array_equal(union(one, nothing)[1], np.arange(len(one)))


def test_dilation_adds_every_cell_within_reach_once() -> None:
    grown = dilated(packed(np.array([[0, 0, 0], [1, 0, 0]])), 1)
    assert len(grown) == 4 * 3 * 3
    assert (np.diff(grown) > 0).all()
    assert len(dilated(np.empty(0, np.int64), 1)) == 0


def test_regions_hang_together_by_faces_edges_and_corners() -> None:
    cells = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 1], [5, 0, 0], [5, 1, 0], [9, 9, 9]])
    count, labels = regions(packed(cells))
    assert count == 3
    assert [len(set(labels[part])) for part in ([0, 1, 2], [3, 4], [5])] == [1, 1, 1]
    assert len({labels[0], labels[3], labels[5]}) == 3


def test_no_voxels_make_no_region() -> None:
    count, labels = regions(np.empty(0, np.int64))
    assert (count, len(labels)) == (0, 0)


def test_offsets_ascend_and_mirror_each_other() -> None:
    steps = offsets(1)
    assert (np.diff(steps) > 0).all()
    assert np.array_equal(steps, -steps[::-1])
