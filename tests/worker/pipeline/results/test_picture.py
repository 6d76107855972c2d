"""The picture of a survey: what stands in it, read back from its pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.pipeline.mapping.fusion import CurrentMap
from worker.pipeline.results.changes import ChangeSet, TileState
from worker.pipeline.results.export import STATE_COLORS
from worker.pipeline.results.picture import _standing, draw_picture


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
    current = CurrentMap(points=reference if survey is None else survey, colors=None)
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
    assert max(_standing(points, 0.0, (0.0, 1000.0, 0.0, 10.0)).shape) <= 4000
    assert _standing(points, 0.0, (0.0, 10.0, 0.0, 5.0)).shape == (100, 200)
