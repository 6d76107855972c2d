"""A training set from one simulated room."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.tiling import TilingSettings
from worker.simulation.training_set import TrainingSetSettings, WalkSettings, build_training_set
from worker.training.dataset import Observation, TileSet

WALKS = WalkSettings(
    stops={"room": 4},
    edits={"room": 6},
    edited_visits=1,
    rebuilds=2,
    second_share=(0.75, 0.75),
    tiling=TilingSettings(min_points=400),
)
ONE_ROOM = TrainingSetSettings(offices=0, corridors=0, rooms=1, walks=WALKS, seed=1001)


@pytest.fixture(scope="module")
def room() -> TileSet:
    return build_training_set(ONE_ROOM, processes=1)


def nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others, axis=2).min(axis=1)


def observations(room: TileSet, *, changed: bool, rebuilt: bool) -> list[Observation]:
    return [
        observation
        for observation in room.observations
        if (observation.changed, observation.rebuilt) == (changed, rebuilt)
    ]


def test_every_tile_was_seen_well_on_both_visits_and_lies_about_its_centre(room):
    assert len(room) >= 5
    for a, b in zip(room.points_a, room.points_b, strict=True):
        assert len(a) >= 400
        assert len(b) >= max(400, len(a) / 2)
        for points in (a, b, *(observation.points for observation in room.observations)):
            assert (np.abs(points) <= np.array([0.75, 0.75, 0.5]) + 1e-3).all()


def test_the_two_visits_are_independent_but_of_the_same_place(room):
    near = []
    for a, b in zip(room.points_a, room.points_b, strict=True):
        assert not set(map(tuple, a)) & set(map(tuple, b))
        near.append(np.median(nearest(a[::5], b)))
    assert np.median(near) < 0.05  # a voxel


def test_an_observation_after_edits_shows_a_surface_that_the_map_has_not_or_misses_one_that_it_has(room):
    changed, beside = (observations(room, changed=which, rebuilt=False) for which in (True, False))
    assert changed
    assert beside
    far = {
        which: [_far(room, observation) for observation in found]
        for which, found in ((1, changed), (0, beside))
    }
    assert np.median(far[1]) > 2 * np.median(far[0])


def test_a_rebuilt_map_keeps_most_points_to_the_bit_and_differs_where_a_change_was_made(room):
    changed, untouched = (observations(room, changed=which, rebuilt=True) for which in (True, False))
    assert changed
    assert untouched
    for observation in (*changed, *untouched):
        a = room.points_a[observation.tile]
        assert not np.array_equal(observation.points, a)
        kept = (
            0.25 if observation.changed else 0.5
        )  # a change may be half of the points; another visit's are some 2 cm off
        assert np.quantile(nearest(observation.points[::5], a), kept) < 0.01
    # A second registration moves a scan by millimetres, a change by centimetres.
    assert max(_far(room, observation) for observation in changed) > 20
    assert np.median([_far(room, observation) for observation in untouched]) < 5


def test_registered_after_the_change_some_of_its_points_lie_in_the_tile_beside_which_has_not_changed():
    walks = WALKS.model_copy(update={"edited_visits": 0, "rebuilds": 3})
    room = build_training_set(ONE_ROOM.model_copy(update={"walks": walks}), processes=1)
    far = [_far(room, observation) for observation in observations(room, changed=False, rebuilt=True)]
    assert sum(count > 0 for count in far) in range(1, len(far) // 4)  # across a border, and few of them


def test_without_further_visits_there_are_no_further_observations():
    bare = WALKS.model_copy(update={"edited_visits": 0, "rebuilds": 0})
    assert build_training_set(ONE_ROOM.model_copy(update={"walks": bare}), processes=1).observations == ()


def test_the_same_seed_builds_the_same_set_in_two_processes_and_its_source_says_which(room):
    two = ONE_ROOM.model_copy(update={"rooms": 2})
    again = build_training_set(two, processes=2)
    assert again.buildings.tolist() == sorted(again.buildings.tolist())
    first = again.subset(again.buildings == 0)
    assert np.array_equal(np.concatenate(room.points_b), np.concatenate(first.points_b))
    assert [(observation.tile, observation.changed) for observation in first.observations] == [
        (observation.tile, observation.changed) for observation in room.observations
    ]
    assert len(again) > len(room)
    assert '"rooms":1' in room.source


def _far(room: TileSet, observation: Observation) -> int:
    """Points of either observation that lie over 10 cm off the other."""
    a = room.points_a[observation.tile]
    return int((nearest(observation.points, a) > 0.1).sum() + (nearest(a, observation.points) > 0.1).sum())
