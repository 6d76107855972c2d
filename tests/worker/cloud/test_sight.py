"""Sights: what scans say of places, on a wall 4 m ahead with a post before it."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.sight import FARTHEST_RESIDUAL, Sights, Verdicts

ORIGIN = np.array([1.0, -2.0, 0.5])


def wall(x: float = 4.0, half: float = 1.5, hole: float = 0.0) -> np.ndarray:
    """Return points 1 cm apart on a wall at `x` metres ahead of the origin, with a hole of so many metres around it."""
    steps = np.arange(-half, half, 0.01)
    y, z = (axis.ravel() for axis in np.meshgrid(steps, steps))
    kept = np.hypot(y, z) >= hole
    return ORIGIN + np.stack([np.full(kept.sum(), x), y[kept], z[kept]], axis=1)


def told(sights: Sights | None, *places: tuple[float, float, float]) -> Verdicts:
    assert sights is not None
    return sights.verdicts(ORIGIN + np.array(places))


def counts(verdicts: Verdicts, row: int = 0) -> tuple[int, ...]:
    return tuple(
        int(part[row]) for part in (verdicts.through, verdicts.surely, verdicts.confirmed, verdicts.hidden)
    )


@pytest.mark.parametrize(
    ("depth", "expected"),
    [
        (2.0, (1, 1, 0, 0)),
        (3.7, (1, 1, 0, 0)),
        (3.95, (0, 0, 1, 0)),
        (4.05, (0, 0, 1, 0)),
        (4.5, (0, 0, 0, 1)),
    ],
)
def test_a_place_before_at_and_behind_a_wall(depth: float, expected: tuple[int, ...]) -> None:
    assert counts(told(Sights.of([(wall(), ORIGIN)]), (depth, 0.0, 0.0))) == expected


def test_nothing_is_said_of_where_nothing_came_back_from() -> None:
    verdicts = told(Sights.of([(wall(), ORIGIN)]), (-2.0, 0.0, 0.0))
    assert counts(verdicts) == (0, 0, 0, 0)
    assert not verdicts.judged[0]
    assert verdicts.residual[0] == np.float32(FARTHEST_RESIDUAL)


def test_the_neighbouring_directions_have_to_be_free_as_well_to_be_sure() -> None:
    beside = wall(x=2.0, half=0.02) + np.array(
        [0.0, 0.075, 0.0]
    )  # a post that ends 5.5 cm beside the place's ray
    verdicts = told(Sights.of([(np.concatenate([wall(), beside]), ORIGIN)]), (3.0, 0.0, 0.0))
    assert (int(verdicts.through[0]), int(verdicts.surely[0])) == (1, 0)


def test_the_neighbours_reach_over_the_edges_of_the_cube() -> None:
    along = np.array([3.0, 2.98, 0.0])  # just within the face ahead
    across = np.array([1.48, 1.51, 0.0])  # nearer, and just within the face to the left
    points = ORIGIN + np.concatenate(
        [along + np.random.default_rng(0).normal(0, 0.005, (20, 3)), across[None]]
    )
    verdicts = told(Sights.of([(points, ORIGIN)]), (2.0, 1.987, 0.0))
    assert (int(verdicts.through[0]), int(verdicts.surely[0])) == (1, 0)


def test_the_residual_is_the_way_to_the_nearest_return_of_any_scan() -> None:
    sights = Sights.joined([Sights.of([(wall(4.0), ORIGIN)]), Sights.of([(wall(3.3), ORIGIN)])])
    verdicts = told(sights, (3.0, 0.0, 0.0), (3.65, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert verdicts.residual == pytest.approx([0.3, 0.35, FARTHEST_RESIDUAL], abs=0.01)
    assert counts(verdicts, 1) == (1, 1, 0, 1)  # one saw through, to the other it was hidden


def test_the_order_of_places_and_what_else_is_asked_changes_no_answer() -> None:
    sights = Sights.of([(wall(), ORIGIN), (wall() + 0.3, ORIGIN + 0.3)])
    assert sights is not None
    places = ORIGIN + np.random.default_rng(1).uniform(-2, 6, (300, 3))
    whole, part = sights.verdicts(places), sights.verdicts(places[::-1][:50])
    for name in ("through", "surely", "confirmed", "hidden", "residual"):
        assert np.array_equal(getattr(whole, name)[::-1][:50], getattr(part, name))


def test_no_scan_gives_no_sights() -> None:
    assert Sights.of([]) is None
    assert Sights.joined([None, None]) is None


def test_one_of_several_scans_can_be_left_out() -> None:
    sights = Sights.of([(wall(), ORIGIN), (wall(2.0), ORIGIN)])
    assert sights is not None
    assert counts(told(sights.subset(np.array([0])), (2.4, 0.0, 0.0))) == (1, 1, 0, 0)
    assert counts(told(sights, (2.4, 0.0, 0.0))) == (1, 1, 0, 1)


def test_beyond_its_farthest_return_a_scan_says_nothing() -> None:
    assert counts(told(Sights.of([(wall(2.0), ORIGIN)]), (3.0, 0.0, 0.0))) == (0, 0, 0, 0)


def _box(near: float, far: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (1, 3), each, of a box around the axis ahead of the origin."""
    return ORIGIN[None] + np.array((near, -half, -half)), ORIGIN[None] + np.array((far, half, half))


def test_a_scan_says_no_more_of_boxes_that_it_is_blinded_for_nor_of_what_lies_behind() -> None:
    sights = Sights.of([(wall(), ORIGIN), (wall(6.0, half=3.0), ORIGIN)])
    assert sights is not None
    low, high = _box(2.0, 2.4, 0.2)
    blinded = sights.blinded(low, high)
    places = ((2.2, 0.0, 0.0), (4.0, 0.0, 0.0), (2.2, 0.6, 0.0), (4.0, 1.0, 0.0))
    before, after = (told(each, *places) for each in (sights, blinded))
    assert [counts(before, row)[0] for row in range(4)] == [2, 1, 2, 1]
    assert [counts(after, row) for row in range(2)] == [(0, 0, 0, 0)] * 2
    assert [counts(after, row) for row in range(2, 4)] == [counts(before, row) for row in range(2, 4)]
    assert sights.nearest.sum() > blinded.nearest.sum()  # what was given stays as it was


def test_a_box_behind_the_wall_or_behind_the_sensor_blinds_no_scan() -> None:
    sights = Sights.of([(wall(), ORIGIN)])
    assert sights is not None
    for ahead in (5.0, -3.0):
        low, high = _box(ahead, ahead + 1, 0.5)
        assert np.array_equal(sights.blinded(low, high).farthest, sights.farthest)
    nothing = np.empty((0, 3))
    assert np.array_equal(sights.blinded(nothing, nothing).farthest, sights.farthest)


def test_what_stands_blocks_the_view_and_what_walked_by_does_not() -> None:
    """A board 2 m ahead was there all the time, one beside it while every tenth return of its directions came."""
    board = wall(2.0, half=0.3)
    aside = board + np.array((0.0, 1.0, 0.0))
    behind = wall(4.0, half=3.0)
    hidden = np.all(np.abs((behind - ORIGIN)[:, 1:]) < 0.6, axis=1)
    sights = Sights.of([(np.concatenate([board, aside[::10], behind[~hidden]]), ORIGIN)])
    assert sights is not None
    inner = np.array([[2.0, 0.0, 0.0], [2.0, 0.1, 0.1], [2.0, 1.0, 0.0], [2.0, 1.1, -0.1], [4.0, -2.0, 0.0]])
    assert sights.stands(ORIGIN + inner).tolist() == [True, True, False, False, True]
    nowhere = np.array([[2.0, -0.5, 0.5], [-2.0, 0.0, 0.0]])
    assert not sights.stands(ORIGIN + nowhere).any()


def test_a_direction_between_scan_lines_takes_the_ranges_around_it_where_they_agree() -> None:
    gap = wall(hole=0.125)  # wider than the cell in its middle
    assert counts(told(Sights.of([(gap, ORIGIN)]), (2.0, 0.0, 0.0))) == (1, 1, 0, 0)
    lone = np.array([[4.0, 0.3, 0.3]]) + ORIGIN
    assert counts(told(Sights.of([(lone, ORIGIN)]), (2.0, 0.0, 0.0))) == (0, 0, 0, 0)
    near, behind = wall(2.0, hole=0.06), gap
    sides = np.concatenate([near[near[:, 1] < ORIGIN[1]], behind[behind[:, 1] >= ORIGIN[1]]])
    assert counts(told(Sights.of([(sides, ORIGIN)]), (1.0, 0.0, 0.0))) == (
        0,
        0,
        0,
        0,
    )  # an edge: nobody knows
