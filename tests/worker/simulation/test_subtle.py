"""Edits that are hard to find, and that they are what they say."""

from __future__ import annotations

import numpy as np
import pytest

from worker.simulation.scenes import random_solids, small_office
from worker.simulation.scenes.subtle import SMALL, nudges, sheets, taken_away, turns


@pytest.fixture(scope="module")
def office():
    return small_office(4)


def test_sheets_hang_three_to_eight_centimetres_before_a_wall(office):
    after, changes = sheets(office, seed=2, count=6)
    assert len(changes) >= 4
    for change in changes:
        mesh = after[change.name].mesh
        assert min(np.ptp(mesh.bounds[:, :2], axis=0)) == pytest.approx(0.01)
        gap = office.caster.distances(mesh.vertices)
        assert gap.min() >= 0.01  # door frames stand out by 2 cm
        low, high = mesh.bounds
        rooms = [np.r_[low[:2] - room.low, np.array(room.high) - high[:2]] for room in office.rooms]
        assert any(0.03 - 1e-9 <= sides.min() <= 0.08 + 1e-9 for sides in rooms)


def test_a_nudged_piece_is_five_to_fifteen_centimetres_away(office):
    after, changes = nudges(office, seed=2, count=5)
    assert len(changes) == 5
    for change in changes:
        shift = after[change.name].mesh.vertices - office[change.name].mesh.vertices
        assert np.allclose(shift, shift[0])
        assert 0.05 <= np.linalg.norm(shift[0]) <= 0.15


def test_chairs_are_turned_in_place(office):
    after, changes = turns(office, seed=2, count=2)
    assert changes
    for change in changes:
        assert change.name.rpartition("-")[0] in ("chair", "swivel-chair")
        middle = [scene[change.name].mesh.vertices.mean(axis=0) for scene in (office, after)]
        assert np.linalg.norm(middle[1] - middle[0]) < 0.2


def test_small_things_can_be_taken_away_again(office):
    before, added = random_solids(office, seed=1, count=6, size=SMALL, places=("floor",), name="small")
    after, changes = taken_away(before, "small", seed=3, count=4)
    assert len(changes) == min(4, len(added))
    assert {change.kind for change in changes} == {"remove"}
    assert len(after.objects) == len(before.objects) - len(changes)
