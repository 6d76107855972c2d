"""The picture of a survey: what stands in it, read back from its pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.cloud.voxels import Voxels
from worker.detectors.detector import VoxelScores
from worker.pipeline.results.changes import ChangeSet, TileState
from worker.pipeline.results.export import STATE_COLORS
from worker.pipeline.results.object_marks import OBJECT_COLORS, badge_places, details, headline
from worker.pipeline.results.objects import ChangeObject, ChangeObjects
from worker.pipeline.results.picture import draw_picture, summary
from worker.pipeline.results.places import Place
from worker.pipeline.results.shapes import Motion
from worker.pipeline.results.sheet import LeftOut, standing


def changes(states: list[TileState], indices: list[tuple[int, int, int]]) -> ChangeSet:
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(4, 1, 2))
    at = np.array(indices, np.int32)
    points = tuple((grid.centers(at)[row : row + 1]).astype(np.float32) for row in range(len(at)))
    probabilities = np.tile(np.array([[0.1, 0.9, 0.0]], np.float32), (len(states), 1))
    pairs = TilePairs(
        reference=Tiles(grid=grid, indices=at, points=points),
        current=points,
        observed=np.array([state is not TileState.UNOBSERVED for state in states]),
    )
    return ChangeSet(
        pairs=pairs, probabilities=probabilities, states=np.array(states, np.uint8), threshold=0.5
    )


def drawn(path: Path, found: ChangeSet, *, survey: np.ndarray | None = None) -> np.ndarray:
    """(rows, columns, 3) 0..1."""
    reference = np.array([[0.0, 0.0, 0.0], [6.0, 1.5, 0.0]], np.float32)
    current = reference if survey is None else survey
    draw_picture(path, reference, current, found, title="Map hall: survey of today")
    return np.asarray(imread(path))[:, :, :3]


def share_near(picture: np.ndarray, color: tuple[int, int, int]) -> float:
    """Share of the pixels within 4/255 of a colour on white at any strength from a third up."""
    ink, gone = np.array(color) / 255, 1 - picture
    strength = np.clip(gone @ (1 - ink) / ((1 - ink) @ (1 - ink)), 0, 1)
    close = np.abs(gone - strength[:, :, None] * (1 - ink)).max(axis=2) < 4 / 255
    return float((close & (strength > 0.3)).mean())


@pytest.mark.parametrize("state", [TileState.CHANGED, TileState.INCONSISTENT, TileState.UNOBSERVED])
def test_a_state_is_drawn_in_its_colour(tmp_path: Path, state: TileState) -> None:
    row = [(i, 0, 0) for i in range(4)]
    quiet = drawn(tmp_path / "quiet.png", changes([TileState.UNCHANGED] * 4, row))
    told = drawn(tmp_path / "told.png", changes([TileState.UNCHANGED, state, state, state], row))
    assert share_near(told, STATE_COLORS[state]) > share_near(quiet, STATE_COLORS[state]) + 0.005


def test_a_changed_tile_shows_through_an_unchanged_one_above_it(tmp_path: Path) -> None:
    states = [TileState.CHANGED, TileState.UNCHANGED]
    below = drawn(tmp_path / "below.png", changes(states, [(0, 0, 0), (0, 0, 1)]))
    above = drawn(tmp_path / "above.png", changes(states[::-1], [(0, 0, 0), (0, 0, 1)]))
    vermilion = STATE_COLORS[TileState.CHANGED]
    assert share_near(below, vermilion) == pytest.approx(share_near(above, vermilion), rel=0.02)
    assert share_near(below, vermilion) > 0.1


def test_what_only_the_survey_saw_is_drawn_in_ink(tmp_path: Path) -> None:
    found = changes([TileState.UNCHANGED] * 4, [(i, 0, 0) for i in range(4)])
    rng = np.random.default_rng(0)
    crate = (rng.random((20_000, 3)) * (1, 1, 1) + (2.5, 0.25, 0.2)).astype(np.float32)
    without = drawn(tmp_path / "without.png", found)
    with_crate = drawn(tmp_path / "with.png", found, survey=crate)
    dark = [(picture.max(axis=2) < 0.15).mean() for picture in (without, with_crate)]
    assert dark[1] > dark[0] + 0.02


def test_one_tile_and_a_long_building_both_make_a_sheet_of_sensible_size(tmp_path: Path) -> None:
    one = drawn(tmp_path / "one.png", changes([TileState.CHANGED], [(0, 0, 0)]))
    long = changes([TileState.CHANGED] * 60, [(i, 0, 0) for i in range(60)])
    for picture in (one, drawn(tmp_path / "long.png", long)):
        rows, columns, _ = picture.shape
        assert 200 < rows < 1800
        assert 800 < columns < 1800


def test_a_very_long_place_is_drawn_in_coarser_pixels() -> None:
    points = np.array([[0.0, 0.0, 0.0], [900.0, 1.0, 1.0]], np.float32)
    assert max(standing(points, 0.0, (0.0, 1000.0, 0.0, 10.0)).shape) <= 4000
    assert standing(points, 0.0, (0.0, 10.0, 0.0, 5.0)).shape == (100, 200)


def place(
    x: float, y: float, *, size: tuple[float, float, float] = (0.6, 0.4, 0.5), high: float | None = 0.1
) -> Place:
    return Place(
        center=(x, y, 0.4),
        size=size,
        yaw=0.3,
        footprint=((x, y), (x + 0.1, y), (x, y + 0.1)),
        height_over_floor=high,
        volume=0.1,
        voxels=100,
        points=1000,
        tiles=("tile_000_000_000",),
    )


def thing(number: int, *, before: Place | None = None, now: Place | None = None) -> ChangeObject:
    both = before is not None and now is not None
    return ChangeObject(
        number=number,
        kind="moved" if both else "appeared" if before is None else "disappeared",
        now=now,
        before=before,
        motion=Motion(translation=(1.2, 0.5, 0.0), yaw=np.radians(-30), overlap=0.8) if both else None,
        score=80.0,
        probability=0.8,
        observed_share=1.0,
        scans_seen_through=3,
    )


def with_objects(*things: ChangeObject) -> ChangeSet:
    """The same hall with things, of which each has one voxel."""
    keys = np.sort(Voxels.keys_of(np.array([[1.0 + number, 0.7, 0.5] for number in range(4)]), size=0.05))
    numbers = np.array([n + 1 if n < len(things) else 0 for n in range(4)], np.int32)
    nothing = np.zeros(4, np.float32)
    return replace(
        changes([TileState.UNCHANGED, TileState.CHANGED, TileState.UNOBSERVED, TileState.UNCHANGED], ROW),
        objects=ChangeObjects(
            objects=things, moving=2, voxel_size=0.05, keys=keys, now=numbers, before=numbers * 0
        ),
        voxels=VoxelScores(
            keys=keys,
            appeared=nothing,
            disappeared=nothing,
            judged=np.ones(4, bool),
            moving=np.zeros(4, bool),
            seen_through=np.zeros(4, np.int16),
        ),
    )


ROW = [(i, 0, 0) for i in range(4)]


@pytest.mark.parametrize(
    "one",
    [
        thing(1, now=place(1.0, 0.7)),
        thing(1, before=place(1.0, 0.7)),
        thing(1, before=place(1.0, 0.7), now=place(3.0, 0.7)),
    ],
)
def test_an_object_is_drawn_in_the_colour_of_its_kind(tmp_path: Path, one: ChangeObject) -> None:
    color = OBJECT_COLORS[one.kind]
    quiet, told = (drawn(tmp_path / "p.png", with_objects(*things)) for things in ((), (one,)))
    assert share_near(told, color) > share_near(quiet, color) + 0.0008


def test_with_objects_a_changed_tile_stands_back(tmp_path: Path) -> None:
    loud = drawn(tmp_path / "loud.png", changes([TileState.UNCHANGED, TileState.CHANGED], ROW[:2]))
    faint = drawn(tmp_path / "faint.png", with_objects())
    vermilion = STATE_COLORS[TileState.CHANGED]
    assert share_near(faint, vermilion) < 0.2 * share_near(loud, vermilion)


def test_a_picture_of_many_objects_is_made_and_counts_those_that_are_not_listed(tmp_path: Path) -> None:
    things = [thing(n, now=place(0.1 * n, 0.7)) for n in range(1, 41)]
    rows, columns, _ = drawn(tmp_path / "many.png", with_objects(*things)).shape
    assert 200 < rows < 1800
    assert 800 < columns < 2400


def test_a_few_points_through_a_window_do_not_widen_the_picture(tmp_path: Path) -> None:
    near = with_objects(thing(1, now=place(1.0, 0.7)))
    full = tuple(np.repeat(points, 1000, axis=0) for points in near.pairs.reference.points)
    far = np.concatenate([near.pairs.reference.indices, [[40, 30, 0]]]).astype(np.int32)
    stray = np.full((3, 3), 50.0, np.float32)
    pairs = TilePairs(
        reference=replace(near.pairs.reference, indices=far, points=(*full, stray)),
        current=(*full, stray),
        observed=np.append(near.pairs.observed, False),
    )
    windowed = replace(
        near,
        pairs=pairs,
        probabilities=np.concatenate([near.probabilities, near.probabilities[:1]]),
        states=np.append(near.states, TileState.UNOBSERVED).astype(np.uint8),
    )
    sizes = [drawn(tmp_path / "p.png", each).shape for each in (near, windowed)]
    assert sizes[0] == sizes[1]


def test_the_head_counts_objects_and_what_moved_meanwhile() -> None:
    said = summary(with_objects(thing(1, now=place(1, 0.7))))
    assert said == "1 object changed, in 1 of 4 tiles; 2 more moved during the visit"
    assert summary(changes([TileState.CHANGED], [(0, 0, 0)])) == "1 of 1 tiles changed, at a score above 0.50"


def test_a_thing_is_listed_by_what_became_of_it_its_size_and_its_height() -> None:
    moved = thing(1, before=place(1, 0.7), now=place(2, 1))
    assert headline(moved) == "moved by 1.3 m, turned by 30°"
    assert headline(thing(1, now=place(1, 0.7))) == "appeared"
    assert details(moved) == "0.6 × 0.4 × 0.5 m, on the floor"
    assert details(thing(1, before=place(1, 0.7, high=0.74))) == "0.6 × 0.4 × 0.5 m, 0.7 m over the floor"
    assert details(thing(1, before=place(1, 0.7, high=None))) == "0.6 × 0.4 × 0.5 m, from z = 0.2 m"


def test_numbers_of_things_side_by_side_do_not_lie_upon_each_other() -> None:
    things = [thing(n, now=place(0.3 * n, 0.7)) for n in range(1, 6)]
    places = np.array(badge_places(things, scale=1.0))
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2)[~np.eye(len(places), dtype=bool)]
    assert gaps.min() > 0.15  # inches, of which a number takes 0.2


def test_a_placement_in_doubt_is_said_at_the_head_in_a_colour_of_its_own(tmp_path: Path) -> None:
    quiet = changes([TileState.CHANGED] * 4, ROW)
    doubted = quiet.in_doubt(0.714)
    assert summary(doubted) == "placement in doubt (confidence 0.71): no tile counts as unchanged"
    alarm = (176, 0, 32)
    shares = [share_near(drawn(tmp_path / "p.png", each)[:90], alarm) for each in (quiet, doubted)]
    assert shares[1] > shares[0] + 0.005


def test_scans_that_were_left_out_have_a_line_at_the_head(tmp_path: Path) -> None:
    found = changes([TileState.UNCHANGED] * 4, ROW)
    without = drawn(tmp_path / "without.png", found)
    left_out = [LeftOut(name="cut short.pcd", reason="unreadable", detail="cut short.pcd: it ends early")]
    points = np.array([[0.0, 0.0, 0.0], [6.0, 1.5, 0.0]], np.float32)
    draw_picture(tmp_path / "with.png", points, points, found, title="Map hall", left_out=left_out)
    told = np.asarray(imread(tmp_path / "with.png"))
    assert told.shape[0] == without.shape[0] + round(0.2 * 130)
