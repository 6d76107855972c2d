"""Things put into a room that was seen twice: where they are, in which visit, and who can decide it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.worker.benchmarks.real.conftest import scan
from worker.benchmarks.real.edits import VOXEL, Side, edited, real_things, surface
from worker.benchmarks.real.visits import TwoVisits
from worker.cloud.voxel_keys import centers, near
from worker.cloud.voxels import Voxels
from worker.training.voxels.solids import Box, CloudObject


@pytest.mark.parametrize("side", ["first", "second"])
def test_things_stand_in_one_visit_and_the_other_looks_through_them(
    empty_room: TwoVisits, side: Side
) -> None:
    pair = edited(empty_room, side, [], seed=3)
    changed, kept = (
        (pair.visits.first, pair.visits.second)
        if side == "first"
        else (pair.visits.second, pair.visits.first)
    )
    before = empty_room.second if side == "first" else empty_room.first
    assert all(np.array_equal(one.points, other.points) for one, other in zip(kept, before, strict=True))
    assert len(pair.regions) >= 2
    keys = np.unique(Voxels.keys_of(changed[0].points, size=VOXEL))
    empty = np.unique(Voxels.keys_of(before[0].points, size=VOXEL))
    for region in pair.regions:
        assert region.side == side
        assert np.isin(region.decidable, region.hit).all()
        assert np.isin(region.decidable, keys).all()
        assert not near(region.decidable, empty, 1).any()
    assert sum(len(region.decidable) for region in pair.regions) > 40
    assert pair.base == empty_room.name


def test_a_pair_is_edited_alike_again_and_otherwise_with_another_seed(empty_room: TwoVisits) -> None:
    first, again, other = (edited(empty_room, "second", [], seed=seed) for seed in (5, 5, 6))
    assert np.array_equal(first.visits.second[0].points, again.visits.second[0].points)
    assert not np.array_equal(first.visits.second[0].points, other.visits.second[0].points)


def test_behind_a_thing_the_other_visit_alone_knows_what_stands_there(empty_room: TwoVisits) -> None:
    """What is hidden from the other visit is no thing to be found there."""
    wall = Box(middle=np.array([2.0, 2.0, 1.25]), half=np.array([0.05, 2.0, 1.25]))  # parts the room in two
    parted = replace(empty_room, second=(scan("2.pcd", (3.0, 2.5, 1.0), boxes=(wall,)),))
    pair = edited(parted, "first", [], seed=3)
    for region in pair.regions:
        places = centers(region.decidable, VOXEL)
        assert (places[:, 0] > 1.9).all()


def test_without_a_sensors_place_points_are_added_and_none_is_hidden(empty_room: TwoVisits) -> None:
    first, second = (
        tuple(replace(one, sensor_origin=None) for one in visit)
        for visit in (empty_room.first, empty_room.second)
    )
    blind = replace(empty_room, first=first, second=second)
    pair = edited(blind, "second", [], seed=1)
    points = pair.visits.second[0].points
    assert np.array_equal(points[: len(second[0].points)], second[0].points)
    assert len(points) > len(second[0].points) + 100
    assert any(len(region.decidable) > 20 for region in pair.regions)


def test_the_surface_of_a_box_is_sampled_on_all_its_sides() -> None:
    box = Box(middle=np.array([1.0, 2.0, 0.5]), half=np.array([0.3, 0.2, 0.25]))
    points = surface(box, 0.02, np.random.default_rng(0))
    off = np.abs(points - box.middle) - box.half
    assert np.abs(off.max(axis=1)).max() < 0.06  # four sigma of the noise, and a little for slanted rays
    for axis in (0, 1):
        for sign in (-1, 1):
            assert (np.abs(sign * (points - box.middle)[:, axis] - box.half[axis]) < 0.02).sum() > 50


def test_a_chair_sized_thing_is_cut_out_and_a_wall_is_not() -> None:
    thing = Box(middle=np.array([2.5, 1.0, 0.3]), half=np.array([0.25, 0.3, 0.3]))
    cut = real_things(scan("1.pcd", (1.0, 1.0, 1.0), boxes=(thing,), step=0.5))
    assert len(cut) == 1
    assert isinstance(cut[0], CloudObject)
    assert thing.holds(cut[0].points, 0.03).all()
