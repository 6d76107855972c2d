"""The training set: kept in one file, parted and joined with every observation at its own tile."""

from __future__ import annotations

import numpy as np
import pytest

from worker.training.dataset import joined, load_tiles, save_tiles, split_tiles


def test_a_saved_set_comes_back_within_half_a_millimetre(tiles, tmp_path):
    save_tiles(tiles, tmp_path / "tiles.npz")
    loaded = load_tiles(tmp_path / "tiles.npz")
    for before, after in zip(
        (*tiles.points_a, *tiles.points_b, *(observation.points for observation in tiles.observations)),
        (*loaded.points_a, *loaded.points_b, *(observation.points for observation in loaded.observations)),
        strict=True,
    ):
        assert after == pytest.approx(before, abs=5e-4)
    assert [
        (observation.tile, observation.changed, observation.rebuilt) for observation in loaded.observations
    ] == [(observation.tile, observation.changed, observation.rebuilt) for observation in tiles.observations]
    assert np.array_equal(loaded.centres, tiles.centres)
    assert np.array_equal(loaded.buildings, tiles.buildings)
    assert (loaded.tile_size, loaded.source) == (tiles.tile_size, tiles.source)


def test_a_file_of_another_kind_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", something=1)
    with pytest.raises(ValueError, match="no training set"):
        load_tiles(tmp_path / "other.npz")


def test_the_split_holds_out_one_region_of_every_building(tiles):
    training, validation = split_tiles(tiles, share=0.2, seed=1)
    assert (len(training), len(validation)) == (32, 8)
    for building in (0, 1):
        region = validation.centres[validation.buildings == building]
        assert len(region) == 4
        assert np.ptp(region, axis=0).max() <= 3.0 + 1e-9  # four of twenty tiles, side by side


def test_observations_stay_with_their_tiles_in_a_part_and_in_a_whole(tiles):
    chosen = np.arange(len(tiles)) % 3 == 1
    part = tiles.subset(chosen)
    assert len(part.observations) == chosen.sum()
    whole = joined([part, tiles], source="both")
    assert len(whole) == len(part) + len(tiles)
    assert np.bincount(whole.buildings).tolist() == [len(part), len(tiles)]
    for one, origin in ((part, part), (whole, whole)):
        for observation in one.observations:
            floor = {tuple(point) for point in origin.points_a[observation.tile].round(1)}
            assert len({tuple(point) for point in observation.points.round(1)} & floor) > 20
    first, later = whole.observations[0], whole.observations[len(part.observations)]
    assert (first.tile, later.tile) == (0, len(part))
    assert np.array_equal(first.points, tiles.observations[1].points)
    assert np.array_equal(later.points, tiles.observations[0].points)
