"""Objects of hand-made changes: boxes that come, go, move and turn, and people who walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from worker.cloud.poses import transformed
from worker.cloud.seen import Seen
from worker.cloud.tiling import TilingSettings, grid_over, pair_tiles, touched_tiles
from worker.cloud.types import Floats
from worker.cloud.voxel_keys import centers, rows_of
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import VoxelScores
from worker.pipeline.results.objects import (
    ChangeObject,
    ChangeObjects,
    ObjectSettings,
    change_objects,
    regions_of,
)
from worker.simulation.scenes import rigid

VOXEL = 0.05


@dataclass(frozen=True)
class Cloud:
    """A scan without a sensor."""

    points: np.ndarray
    sensor_origin: None = None


def floor() -> Floats:
    """A floor of 10 x 8 m at z = 0, a point every 2.5 cm."""
    x, y = np.meshgrid(np.arange(0, 10, 0.025), np.arange(0, 8, 0.025))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def box(
    x: float,
    y: float,
    *,
    size: tuple[float, float, float] = (0.6, 0.4, 0.5),
    yaw: float = 0.0,
    z: float = 0.1,
) -> Floats:
    """The sides and the top of a box over the floor, a point every 2.5 cm; yaw in degrees."""
    lines = [np.arange(-edge / 2, edge / 2 + 1e-6, 0.025) for edge in size]
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    rim = np.abs(grid) > np.array(size) / 2 - 0.01
    shell = grid[rim[:, 0] | rim[:, 1] | (grid[:, 2] > size[2] / 2 - 0.01)]
    return transformed(shell, rigid(x, y, z + size[2] / 2, yaw=yaw))


def column(x: float, y: float, *, radius: float = 0.25, height: float = 1.0) -> Floats:
    turns, heights = np.meshgrid(np.arange(0, 2 * np.pi, 0.025 / radius), np.arange(0.1, height, 0.025))
    return np.column_stack(
        [x + radius * np.cos(turns.ravel()), y + radius * np.sin(turns.ravel()), heights.ravel()]
    )


def scene(before: list[Floats], now: list[Floats], *, walking: list[Floats] | None = None) -> ChangeObjects:
    """Find the objects where a detector is right about every voxel; who walks is in the second visit."""
    comparison, voxels = told(before, now, walking or [])
    return change_objects(comparison, voxels)


def told(
    before: list[Floats], now: list[Floats], walking: list[Floats], *, probability: float = 0.9
) -> tuple[Comparison, VoxelScores]:
    """Compare two visits: what only one of them has has changed, and what walked has as well, but moved."""
    first, second = (_seen([floor(), *parts]) for parts in (before, [*now, *walking]))
    moving = _seen([np.empty((0, 3)), *walking]).keys
    return compared(first, second, moving=moving, probability=probability)


def compared(
    first: Seen, second: Seen, *, moving: np.ndarray | None = None, probability: float = 0.9
) -> tuple[Comparison, VoxelScores]:
    """Call every voxel changed that only one of two visits hit."""
    keys = np.union1d(first.keys, second.keys)
    come, gone = (
        (rows_of(keys, own.keys) >= 0) & (rows_of(keys, other.keys) < 0)
        for own, other in ((second, first), (first, second))
    )
    voxels = VoxelScores(
        keys=keys,
        appeared=np.where(come, probability, 0).astype(np.float32),
        disappeared=np.where(gone, probability, 0).astype(np.float32),
        judged=np.ones(len(keys), bool),
        moving=np.isin(keys, [] if moving is None else moving),
        seen_through=np.where(come | gone, 3, 0).astype(np.int16),
    )
    grid = grid_over(first.points, tile_size=(1.5, 1.5, 1.0), voxel_size=VOXEL)
    tiles = touched_tiles(first.points, second.points, grid)
    pairs = pair_tiles(tiles, second.points, settings=TilingSettings(tiles="touched", min_points=1))
    sides = [Side(points=seen.points, seen=seen) for seen in (first, second)]
    return Comparison(reference=sides[0], current=sides[1], tile_pairs=pairs), voxels


def _seen(parts: list[Floats]) -> Seen:
    # half a voxel away from the borders of voxels, so that no rounding moves a flat side across one
    return Seen.of([Cloud(points=np.concatenate(parts) + 0.02)], voxel_size=VOXEL)


def only(objects: ChangeObjects) -> ChangeObject:
    (thing,) = objects.objects
    return thing


def test_nothing_changed_is_no_object() -> None:
    objects = scene([box(3, 3)], [box(3, 3)])
    assert objects.objects == ()
    assert objects.counts() == {"appeared": 0, "disappeared": 0, "moved": 0}
    assert not objects.now.any()
    assert not objects.before.any()


def test_a_box_that_is_put_there_appeared_where_it_stands_with_its_size() -> None:
    thing = only(scene([], [box(3, 3, yaw=30)]))
    assert (thing.number, thing.kind, thing.before, thing.motion) == (1, "appeared", None, None)
    assert thing.now is not None
    assert thing.now.center == pytest.approx((3.02, 3.02, 0.37), abs=0.03)
    along = sorted(thing.now.size[:2])
    assert along == pytest.approx([0.4, 0.6], abs=0.06)
    assert thing.now.size[2] == pytest.approx(0.5, abs=0.05)
    assert np.degrees(thing.now.yaw) in (pytest.approx(30, abs=3), pytest.approx(60, abs=3))
    assert thing.now.height_over_floor == pytest.approx(0.1, abs=0.03)
    assert thing.now.volume == pytest.approx(0.6 * 0.4 * 0.5, rel=0.2)
    assert thing.probability == pytest.approx(0.9)
    assert thing.score == pytest.approx(0.9 * thing.now.voxels)
    assert (thing.observed_share, thing.scans_seen_through) == (1.0, 3)
    assert thing.now.tiles == ("tile_001_001_000", "tile_001_002_000", "tile_002_001_000", "tile_002_002_000")


def test_the_footprint_is_the_outline_from_above_counter_clockwise() -> None:
    thing = only(scene([], [box(3, 3)]))
    assert thing.now is not None
    outline = np.array(thing.now.footprint)
    assert outline.min(axis=0) == pytest.approx([2.72, 2.82], abs=0.03)
    assert outline.max(axis=0) == pytest.approx([3.32, 3.22], abs=0.03)
    following = np.roll(outline, -1, axis=0)
    area = (outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1]).sum() / 2
    assert area == pytest.approx(0.24, abs=0.05)


def test_a_box_that_is_taken_away_disappeared_from_where_it_stood() -> None:
    thing = only(scene([box(3, 3)], []))
    assert (thing.kind, thing.now, thing.motion) == ("disappeared", None, None)
    assert thing.before is not None
    assert thing.before.center == pytest.approx((3.02, 3.02, 0.37), abs=0.03)


def test_a_box_that_is_carried_and_turned_moved_by_that() -> None:
    thing = only(scene([box(3, 3)], [box(4.5, 2.5, yaw=40)]))
    assert thing.kind == "moved"
    assert thing.before is not None
    assert thing.now is not None
    assert thing.motion is not None
    assert thing.motion.translation == pytest.approx((1.5, -0.5, 0.0), abs=0.05)
    assert thing.motion.yaw == pytest.approx(np.radians(40), abs=0.06)


def test_a_box_that_is_pushed_by_less_than_its_size_moved_by_that() -> None:
    comparison, voxels = told([box(3, 3)], [box(3.2, 3)], [])
    inside = (
        np.abs(centers(voxels.keys, VOXEL)[:, 0] - 3.12) < 0.22
    )  # each box where the other is: nobody can see in
    seen = VoxelScores(
        keys=voxels.keys,
        appeared=voxels.appeared * ~inside,
        disappeared=voxels.disappeared * ~inside,
        judged=~(inside & (voxels.appeared + voxels.disappeared > 0)),
        moving=voxels.moving,
        seen_through=voxels.seen_through,
    )
    thing = only(change_objects(comparison, seen))
    assert thing.kind == "moved"
    assert thing.motion is not None
    assert thing.motion.translation == pytest.approx((0.2, 0.0, 0.0), abs=0.05)
    assert thing.motion.yaw == pytest.approx(0.0, abs=0.1)


def test_a_column_has_no_yaw() -> None:
    thing = only(scene([column(3, 3)], [column(5, 3)]))
    assert thing.kind == "moved"
    assert thing.motion is not None
    assert thing.motion.translation == pytest.approx((2.0, 0.0, 0.0), abs=0.05)
    assert thing.motion.yaw is None


def test_of_two_alike_boxes_each_is_paired_with_the_nearer_one() -> None:
    objects = scene([box(2, 2), box(2, 6)], [box(3, 2), box(3.5, 6)])
    shifts = sorted(thing.motion.translation[0] for thing in objects.objects if thing.motion is not None)
    assert shifts == pytest.approx([1.0, 1.5], abs=0.05)


def test_where_two_alike_boxes_are_as_near_nobody_says_which_was_moved() -> None:
    objects = scene([box(4, 4)], [box(3, 4), box(5, 4)])
    assert objects.counts() == {"appeared": 2, "disappeared": 1, "moved": 0}


def test_a_box_of_another_size_is_another_thing() -> None:
    objects = scene([box(3, 3)], [box(5, 3, size=(1.2, 0.8, 0.9))])
    assert objects.counts() == {"appeared": 1, "disappeared": 1, "moved": 0}


def test_a_box_far_away_is_another_thing() -> None:
    objects = scene([box(1, 1)], [box(9, 7)])
    assert objects.counts() == {"appeared": 1, "disappeared": 1, "moved": 0}


def test_objects_are_numbered_by_their_scores_and_their_voxels_bear_the_numbers() -> None:
    objects = scene([box(7, 5)], [box(3, 3, size=(1.2, 0.8, 0.9))])
    assert [(thing.number, thing.kind) for thing in objects.objects] == [(1, "appeared"), (2, "disappeared")]
    for thing, numbers in zip(objects.objects, (objects.now, objects.before), strict=True):
        (place,) = thing.places
        assert (numbers == thing.number).sum() == place.voxels
        assert set(np.unique(numbers)) == {0, thing.number}


def test_a_region_under_the_size_is_no_object() -> None:
    comparison, voxels = told([], [box(3, 3, size=(0.1, 0.1, 0.2))], [])
    (region,) = regions_of(voxels, voxels.appeared, ObjectSettings(min_voxels=1))
    count = len(region.rows)
    assert len(change_objects(comparison, voxels, ObjectSettings(min_voxels=count)).objects) == 1
    assert change_objects(comparison, voxels, ObjectSettings(min_voxels=count + 1)).objects == ()
    enough = ObjectSettings(min_voxels=1, min_score=0.9 * count - 0.01)
    assert len(change_objects(comparison, voxels, enough).objects) == 1
    too_little = ObjectSettings(min_voxels=1, min_score=0.9 * count + 0.01)
    assert change_objects(comparison, voxels, too_little).objects == ()


def test_a_voxel_counts_from_above_the_probability() -> None:
    comparison, voxels = told([], [box(3, 3)], [], probability=0.6)
    assert len(change_objects(comparison, voxels).objects) == 1
    assert change_objects(comparison, voxels, ObjectSettings(probability=0.7)).objects == ()


def test_people_who_walk_are_counted_and_no_objects() -> None:
    objects = scene([], [box(6, 6)], walking=[column(2, 2), column(4, 2)])
    assert objects.counts() == {"appeared": 1, "disappeared": 0, "moved": 0}
    assert objects.moving == 2


def test_without_a_floor_nothing_is_said_of_the_height_over_it() -> None:
    thing = only(scene([], [box(3, 3, z=4.0)]))
    assert thing.now is not None
    assert thing.now.height_over_floor is None


def test_without_what_both_visits_saw_there_are_no_objects() -> None:
    comparison, voxels = told([], [box(3, 3)], [])
    blind = Comparison(
        reference=comparison.reference,
        current=Side(points=comparison.current.points),
        tile_pairs=comparison.tile_pairs,
    )
    with pytest.raises(ValueError, match="nobody kept it"):
        change_objects(blind, voxels)
