from __future__ import annotations

import numpy as np

from worker.cloud.tiling import TileGrid
from worker.pipeline.placement.contradictions import Held
from worker.pipeline.placement.displacement import displaced_tiles

GRID = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(4, 4, 2))


def held(*, off: float, at: float = 0.5, count: int = 40, building: bool = True) -> Held:
    """`count` points around x = `at` of the first row of tiles, of which a share is off."""
    points = np.column_stack([np.full(count, at), np.full(count, 0.5), np.full(count, 0.5)])
    yes, no = np.ones(count, bool), np.zeros(count, bool)
    return Held(
        points=points,
        building=yes if building else no,
        judged=yes,
        through=no,
        near=yes,
        off=np.arange(count) < off * count,
    )


def test_a_tile_whose_walls_are_off_in_both_directions_is_displaced() -> None:
    far = held(off=0.0, at=4.0)
    pairs = [(held(off=0.8), held(off=0.9)), (far, far)]
    assert displaced_tiles(pairs, GRID).tolist() == [[0, 0, 0]]


def test_walls_that_are_off_in_one_direction_alone_may_be_new() -> None:
    assert not len(displaced_tiles([(held(off=0.8), held(off=0.1))], GRID))


def test_things_that_are_off_displace_nothing() -> None:
    things = held(off=1.0, building=False)
    assert not len(displaced_tiles([(things, things)], GRID))


def test_a_few_points_prove_no_displacement() -> None:
    few = held(off=1.0, count=8)
    assert not len(displaced_tiles([(few, few)], GRID))


def test_the_scans_of_a_survey_are_counted_together() -> None:
    few = held(off=1.0, count=8)
    assert len(displaced_tiles([(few, few), (few, few)], GRID)) == 1


def test_a_survey_without_rays_has_no_displaced_tile() -> None:
    assert displaced_tiles([], GRID).shape == (0, 3)
