from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.rooms import scores_of
from tests.support.tilings import grid_of, in_tile, row_of
from worker.cloud.poses import exponential
from worker.cloud.tiling import TilingSettings, cut, grown, pair_tiles
from worker.pipeline import archive
from worker.pipeline.mapping.fusion import CurrentMap, ReferenceMap
from worker.pipeline.registration.results import RegisteredScan
from worker.pipeline.results.manifest import manifest, padded_patches

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(7, 3)).astype(np.float32)
COLORS = RNG.integers(0, 256, (7, 3)).astype(np.uint8)


def assert_same(a: Any, b: Any) -> None:
    """Equal to the bit and in type, through values, tuples and arrays; NaN equals NaN."""
    if is_dataclass(a):
        assert type(a) is type(b)
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert type(a) is type(b)
        assert a == b


@pytest.mark.parametrize("colors", [COLORS, None])
def test_a_reference_comes_back_equal(tmp_path: Path, colors: np.ndarray | None) -> None:
    reference = ReferenceMap(
        points=POINTS, normals=-POINTS, oriented=POINTS[:, 0] > 0, colors=colors, voxel_size=0.05
    )
    archive.save_reference(tmp_path / "r.npz", reference)
    assert_same(reference, archive.load_reference(tmp_path / "r.npz"))


@pytest.mark.parametrize("colors", [COLORS, None])
def test_a_current_map_comes_back_equal(tmp_path: Path, colors: np.ndarray | None) -> None:
    archive.save_current(tmp_path / "c.npz", CurrentMap(points=POINTS, colors=colors))
    assert_same(CurrentMap(points=POINTS, colors=colors), archive.load_current(tmp_path / "c.npz"))


@pytest.mark.parametrize("current", [(5, 0, 9), (0, 0, 0), (1, 2, 0)])
def test_pairs_come_back_equal_with_empty_tiles_in_any_place(
    tmp_path: Path, current: tuple[int, ...]
) -> None:
    pairs = row_of([6, 1, 8], current, observed=[True, False, True])
    archive.save_pairs(tmp_path / "p.npz", pairs)
    assert_same(pairs, archive.load_pairs(tmp_path / "p.npz"))


@pytest.mark.parametrize("counts", [(6, 1, 8), (3,), ()])
def test_tiles_come_back_equal(tmp_path: Path, counts: tuple[int, ...]) -> None:
    tiles = row_of(counts, counts, observed=[True] * len(counts)).reference
    patches = padded_patches(tiles, size=10, seed=42)
    archive.save_tiles(tmp_path / "t.npz", tiles, patches=patches)
    assert_same(tiles, archive.load_tiles(tmp_path / "t.npz"))


def test_dense_tiles_and_patches_lie_where_the_manifest_says(tmp_path: Path) -> None:
    tiles = row_of([6, 12], [6, 12], observed=[True, True]).reference
    patches = padded_patches(tiles, size=10, seed=42)
    archive.save_tiles(tmp_path / "tiles.npz", tiles, patches=patches)
    cloud = np.concatenate(tiles.points)
    listing = manifest(cloud, tiles, patch_size=10, min_points=1, voxel_size=0.05)
    kept = archive.load_arrays(tmp_path / "tiles.npz")
    for entry, dense in zip(listing["patches"], tiles.points, strict=True):
        (file, patch), (dense_file, whole) = (entry[key].split("#") for key in ("file", "dense_file"))
        assert file == dense_file == "tiles.npz"
        assert_same(dense, kept[whole])
        assert kept[patch].shape == (entry["n_sampled_points"], 3)
        there = kept[patch] + np.array(entry["tile_center"], np.float32)
        assert np.linalg.norm(there[:, None] - dense[None], axis=2).min(axis=1).max() < 1e-5


def test_scores_come_back_equal_with_nan(tmp_path: Path) -> None:
    scores = scores_of((0.1, 0.2, 0.7), (float("nan"),) * 3)
    archive.save_scores(tmp_path / "s.npz", scores)
    assert_same(scores, archive.load_scores(tmp_path / "s.npz"))


@pytest.mark.parametrize("colors", [COLORS, None])
@pytest.mark.parametrize("origin", [np.array([1.0, 2.0, 0.3]), None])
def test_a_scan_comes_back_with_its_pose_and_its_sensors_place_where_known(
    tmp_path: Path, origin: np.ndarray | None, colors: np.ndarray | None
) -> None:
    scan = RegisteredScan(
        name="now.npz",
        points=POINTS,
        colors=colors,
        map_from_scan=exponential(np.array([0, 0, 1, 2, 3, 4.0])),
        sensor_origin=origin,
    )
    archive.save_scan(tmp_path / "now.npz", scan)
    assert_same(scan, archive.load_scan(tmp_path / "now.npz"))


def test_a_grid_keeps_the_indices_below_zero_that_it_grew(tmp_path: Path) -> None:
    points = np.concatenate([in_tile(-2, 0, 0, 9), in_tile(0, 0, 0, 9)])
    tiles = cut(points, grown(grid_of(1, 1, 1), points), min_points=1)
    assert tiles.grid.lowest == (-2, 0, 0)
    archive.save_tiles(tmp_path / "t.npz", tiles, patches=padded_patches(tiles, size=10, seed=42))
    assert_same(tiles, archive.load_tiles(tmp_path / "t.npz"))
    pairs = pair_tiles(tiles, points, settings=TilingSettings(min_points=1))
    archive.save_pairs(tmp_path / "p.npz", pairs)
    assert_same(pairs, archive.load_pairs(tmp_path / "p.npz"))


def test_tiles_that_say_nothing_of_a_lowest_index_begin_at_0(tmp_path: Path) -> None:
    """Maps that were written before a map could grow."""
    tiles = row_of([6, 1], [6, 1], observed=[True, True]).reference
    archive.save_tiles(tmp_path / "new.npz", tiles, patches=padded_patches(tiles, size=10, seed=42))
    arrays = archive.load_arrays(tmp_path / "new.npz")
    del arrays["lowest"]
    archive.save_arrays(tmp_path / "old.npz", arrays)
    assert_same(tiles, archive.load_tiles(tmp_path / "old.npz"))


def test_the_same_values_give_the_same_bytes(tmp_path: Path) -> None:
    pairs = row_of([6, 1], [2, 3], observed=[True, True])
    for name in "ab":
        archive.save_pairs(tmp_path / name, pairs)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_failed_write_leaves_the_earlier_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.npz"
    archive.save_arrays(path, {"a": POINTS})

    def disk_full(file: Any, **arrays: Any) -> None:
        file.write(b"PK half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", disk_full)
    with pytest.raises(OSError, match="No space"):
        archive.save_arrays(path, {"a": POINTS * 2})
    with pytest.raises(OSError, match="No space"):
        archive.save_arrays(tmp_path / "new.npz", {"a": POINTS})
    assert_same({"a": POINTS}["a"], archive.load_arrays(path)["a"])
    assert not (tmp_path / "new.npz").exists()


def test_anything_else_than_an_archive_of_arrays_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("tiles, but not as arrays")
    with pytest.raises(ValueError, match="pickle"):
        archive.load_arrays(tmp_path / "text.npz")


def test_an_archive_with_a_pickle_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "p.npz", evil=np.array([{"run": "this"}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        archive.load_arrays(tmp_path / "p.npz")
