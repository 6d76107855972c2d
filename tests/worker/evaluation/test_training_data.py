"""A training set from one simulated room."""

from __future__ import annotations

import numpy as np
import pytest

from worker.evaluation.training_data import TrainingSetSettings, build_training_set
from worker.pipeline.tiling import TilingSettings
from worker.training.dataset import TileSet

ONE_ROOM = TrainingSetSettings(
    offices=0, corridors=0, rooms=1, stops={"room": 3}, tiling=TilingSettings(min_points=400)
)


@pytest.fixture(scope="module")
def room() -> TileSet:
    return build_training_set(ONE_ROOM)


def test_every_tile_was_seen_well_on_both_visits_and_lies_about_its_centre(room):
    assert len(room) >= 5
    for a, b in zip(room.points_a, room.points_b, strict=True):
        assert len(a) >= 400
        assert len(b) >= max(400, len(a) / 2)
        for points in (a, b):
            assert (np.abs(points) <= np.array([0.75, 0.75, 0.5]) + 1e-3).all()


def test_the_two_visits_are_independent_but_of_the_same_place(room):
    near = []
    for a, b in zip(room.points_a, room.points_b, strict=True):
        assert not set(map(tuple, a)) & set(map(tuple, b))
        near.append(np.median(np.linalg.norm(a[::5, None] - b, axis=2).min(axis=1)))
    assert np.median(near) < 0.05  # a voxel


def test_the_same_seed_builds_the_same_set_and_its_source_says_which(room):
    again = build_training_set(ONE_ROOM)
    assert np.array_equal(np.concatenate(room.points_b), np.concatenate(again.points_b))
    assert '"rooms":1' in room.source
