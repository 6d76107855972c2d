"""What is counted as found, false or known, and which tiles count, in answers made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from worker.benchmarks.real import measures
from worker.benchmarks.real.answers import Answer, FoundObject, tiles_of
from worker.benchmarks.real.edits import EditedVisits, Side, TrueRegion
from worker.benchmarks.real.measures import Figures, counts_of, groups_of
from worker.benchmarks.real.visits import RealScan, TwoVisits
from worker.cloud.tiling import TileGrid
from worker.cloud.voxel_keys import Keys, centers, packed
from worker.pipeline.results.changes import TileState

GRID = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(4, 1, 1))
NONE = np.empty(0, np.int64)


def block(x: int, *, size: tuple[int, int, int] = (4, 4, 4)) -> Keys:
    """Return the voxels of a block that begins at cell (x, 2, 2)."""
    cells = np.stack(np.meshgrid(*(np.arange(count) for count in size), indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    return np.sort(packed(cells + np.array([x, 2, 2])))


def found(now: Keys = NONE, before: Keys = NONE) -> FoundObject:
    return FoundObject(change=cast(Any, None), before=before, now=now)


def answer(objects: Sequence[FoundObject] | None, changed: Sequence[int] = ()) -> Answer:
    """Answer with four tiles in a row, of which some are changed."""
    scores = np.array([0.9 if tile in changed else 0.1 for tile in range(4)], np.float32)
    return Answer(
        model="one/1",
        grid=GRID,
        tiles=np.array([[tile, 0, 0] for tile in range(4)], np.int32),
        scores=scores,
        states=np.where(scores > 0.5, TileState.CHANGED, TileState.UNCHANGED).astype(np.uint8),
        threshold=0.5,
        least_score=0.0,
        objects=None if objects is None else tuple(objects),
        moving=0,
        judged=0,
        voxels=0,
        seconds=0.0,
    )


def region(keys: Keys, *, side: Side = "second", decidable: Keys | None = None) -> TrueRegion:
    return TrueRegion(kind="box", side=side, decidable=keys if decidable is None else decidable, hit=keys)


def pair(*regions: TrueRegion, place: str = "a room") -> EditedVisits:
    """Put regions into visits that touched the middles of all four tiles."""
    points = GRID.centers(np.array([[tile, 0, 0] for tile in range(4)], np.int32)).astype(np.float32)
    scan = RealScan(name="1", points=points, sensor_origin=np.zeros(3))
    visits = TwoVisits(name="edited", place=place, first=(scan,), second=(scan,))
    return EditedVisits(base="as it is", visits=visits, regions=regions)


def test_a_thing_is_found_by_an_object_of_the_right_visit_that_covers_a_quarter() -> None:
    thing = block(5)  # 64 voxels
    quarter, less = block(5, size=(1, 4, 4)), block(5, size=(1, 2, 2))
    for objects, expected in (([found(now=quarter)], True), ([found(before=quarter)], False), ([], False)):
        assert counts_of(pair(region(thing)), answer(objects), answer([])).found == (expected,)
    assert counts_of(pair(region(thing, side="first")), answer([found(before=thing)]), answer([])).found == (
        True,
    )
    far = replace(found(now=less))  # 4 voxels and those beside them are 18 of 64
    assert counts_of(pair(region(thing)), answer([far]), answer([])).found == (True,)
    assert counts_of(pair(region(block(5, size=(8, 8, 8)))), answer([far]), answer([])).found == (False,)


def test_a_thing_that_too_few_rays_decide_is_not_sought() -> None:
    thing = region(block(5), decidable=block(5, size=(3, 4, 3)))  # 36
    counts = counts_of(pair(thing), answer([found(now=block(5))]), answer([]))
    assert counts.found == ()
    assert (counts.true_objects, counts.false_objects) == (1, 0)  # nor is it wrong to tell of it


def test_an_object_by_no_thing_is_false_unless_the_real_pair_had_it() -> None:
    thing, elsewhere, small = block(5), block(50), block(70, size=(3, 3, 3))
    objects = [found(now=thing), found(now=elsewhere), found(now=small)]
    counts = counts_of(pair(region(thing)), answer(objects), answer([]))
    assert (counts.true_objects, counts.false_objects, counts.false_of_any_size) == (1, 1, 2)
    counts = counts_of(pair(region(thing)), answer(objects), answer([found(now=block(51))]))
    assert (counts.true_objects, counts.false_objects, counts.false_of_any_size) == (1, 0, 1)
    counts = counts_of(
        pair(region(thing)), answer(objects), answer([found(before=block(51))])
    )  # of the other visit
    assert counts.false_objects == 1


def test_tiles_with_a_thing_are_changed_and_those_with_too_little_of_one_do_not_count() -> None:
    thing, little = block(5), block(35, size=(2, 2, 2))  # in the first tile; eight voxels in the second
    assert tiles_of(centers(thing, 0.05), GRID)[:, 0].tolist() == [0] * 64
    tiles = counts_of(pair(region(thing), region(little)), answer([], changed=(0, 1, 2)), answer([])).tiles
    assert (tiles.true_positives, tiles.false_positives, tiles.false_negatives, tiles.true_negatives) == (
        1,
        1,
        0,
        1,
    )
    tiles = counts_of(pair(region(thing)), answer([]), answer([])).tiles
    assert (tiles.true_positives, tiles.false_negatives, tiles.true_negatives) == (0, 1, 3)


def test_a_tile_that_is_not_scored_or_not_observed_is_missed() -> None:
    said = answer([], changed=(0,))
    unobserved = replace(said, states=np.full(4, TileState.UNOBSERVED, np.uint8))
    nowhere = replace(said, tiles=said.tiles + 50)
    for one in (unobserved, nowhere):
        assert counts_of(pair(region(block(5))), one, answer([])).tiles.false_negatives == 1


def test_tiles_by_a_real_change_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    low, high = np.array([3.1, 0.1, 0.1]), np.array([3.2, 0.2, 0.2])  # in the third tile
    monkeypatch.setattr(measures, "REAL_CHANGES", {"a room": ((low, high),)})
    tiles = counts_of(pair(region(block(5))), answer([], changed=(2,)), answer([])).tiles
    assert (tiles.false_positives, tiles.true_negatives) == (0, 2)


def test_figures_add_up_pairs_and_a_model_of_tiles_has_no_objects() -> None:
    thing = block(5)
    hit = counts_of(pair(region(thing)), answer([found(now=thing)], changed=(0,)), answer([]))
    miss = counts_of(pair(region(thing)), answer([found(now=block(50))]), answer([]))
    figures = Figures.of([hit, miss]).document()
    assert (figures["things"], figures["found"], figures["recall"]) == (2, 1, 0.5)
    assert (figures["objects"], figures["precision"], figures["false_objects_a_pair"]) == (2, 0.5, 0.5)
    assert figures["tiles"]["recall"] == 0.5
    assert groups_of([hit, miss]) == {
        "place": {"a room": (1, 2)},
        "visit": {"appeared": (1, 2)},
        "kind": {"box": (1, 2)},
    }
    tiles_alone = Figures.of(
        [counts_of(pair(region(thing)), answer(None, changed=(0,)), answer(None))]
    ).document()
    assert (tiles_alone["found"], tiles_alone["recall"], tiles_alone["precision"]) == (None, None, None)
    assert tiles_alone["tiles"]["f1"] == 1.0
