from __future__ import annotations

import numpy as np
import pytest

from tests.support.graphs import shifted
from worker.pipeline.mapping.pair_selection import Extent, best_pairs, likely_pairs
from worker.pipeline.mapping.settings import MappingSettings

SETTINGS = MappingSettings()


def box(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, size: tuple[float, float, float]) -> Extent:
    """Centred in (x, y, z)."""
    center, half = np.array([x, y, z]), np.array(size) / 2
    return Extent(low=center - half, high=center + half, centroid=center)


ROOM = (6.0, 5.0, 2.6)


def pairs_of(*boxes: Extent, **settings: float) -> list[tuple[int, int]]:
    return likely_pairs(dict(enumerate(boxes)), SETTINGS.model_copy(update=settings))


def test_an_extent_is_that_of_the_points_under_the_pose_without_a_few_far_returns() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 1, (2000, 3)) * (4, 2, 1), np.full((20, 3), 90.0)])
    extent = Extent.of(points, shifted(10.0, 0, 0, yaw=np.pi / 2))
    assert extent.low == pytest.approx([8.1, 0.2, 0.05], abs=0.1)  # x is where -y was
    assert extent.high == pytest.approx([9.9, 3.8, 0.95], abs=0.1)


def test_boxes_that_share_nothing_are_no_pair() -> None:
    assert pairs_of(box(size=ROOM), box(3.0, size=ROOM)) == [(0, 1)]
    assert pairs_of(box(size=ROOM), box(6.1, size=ROOM)) == []
    assert pairs_of(box(size=ROOM), box(0, 5.1, size=ROOM)) == []


def test_two_sides_that_are_apart_do_not_make_a_volume_that_is_shared() -> None:
    """Negative gaps along two axes multiply to something above zero."""
    closet = (3.0, 3.0, 2.6)
    assert pairs_of(box(size=closet), box(6.0, 6.0, size=closet)) == []


def test_what_two_boxes_share_is_judged_by_the_smaller_one() -> None:
    closet = box(3.2, size=(1.0, 1.0, 2.6))  # three tenths of it within the room, of which it is little
    assert pairs_of(box(size=ROOM), closet) == [(0, 1)]
    assert pairs_of(box(size=ROOM), closet, min_box_overlap=0.31) == []


def test_two_floors_are_no_pair_though_their_boxes_share_a_stairwell() -> None:
    tall = (6.0, 5.0, 4.0)
    assert pairs_of(box(size=tall), box(z=1.4, size=tall)) == [(0, 1)]
    assert pairs_of(box(size=tall), box(z=1.6, size=tall)) == []


def test_centroids_more_than_ten_metres_apart_are_no_pair() -> None:
    hall = (40.0, 8.0, 3.0)
    assert pairs_of(box(size=hall), box(9.9, size=hall)) == [(0, 1)]
    assert pairs_of(box(size=hall), box(10.1, size=hall)) == []


def test_a_scan_proposes_no_more_than_its_likeliest_partners() -> None:
    row = [box(0.5 * number, size=ROOM) for number in range(9)]
    proposed = pairs_of(*row, partners=2)
    assert (0, 1) in proposed
    assert (0, 2) in proposed
    assert (0, 3) not in proposed  # neither's likeliest
    assert len(proposed) <= 2 * len(row)
    assert all(b - a <= 2 for a, b in proposed)


def test_a_box_of_like_extent_comes_before_a_large_one_that_holds_it() -> None:
    small, large = (4.0, 4.0, 2.6), (18.0, 9.0, 2.6)
    boxes = (
        box(size=small),
        box(0.5, size=large),
        box(1.0, size=small),
        box(0.6, size=large),
    )
    assert pairs_of(*boxes, partners=1) == [(0, 2), (1, 3)]


def test_a_line_of_42_scans_saves_more_than_80_percent_of_861_pairs() -> None:
    row = [box(2.4 * number, size=(12.0, 2.4, 2.6)) for number in range(42)]
    pairs = pairs_of(*row)
    assert len(pairs) < 0.2 * 861
    assert {(number, number + 1) for number in range(41)} <= set(pairs)  # and yet nobody is left alone


def test_pairs_name_the_lower_index_first_whatever_the_order_and_the_gaps() -> None:
    extents = {7: box(size=ROOM), 3: box(0.5, size=ROOM), 5: box(20.0, size=ROOM)}
    assert likely_pairs(extents, SETTINGS) == [(3, 7)]


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_scans_have_no_pair(count: int) -> None:
    assert pairs_of(*[box(size=ROOM)] * count) == []


def test_a_rank_of_0_is_no_pair_though_places_are_free() -> None:
    rank = np.array([[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]])
    assert best_pairs([4, 6, 9], rank, partners=2) == [(4, 6)]
