from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from service.api.manifests import Manifest
from tests.support.tilings import grid_of, in_tile
from worker.cloud.tiling import TileGrid, cut, grown
from worker.pipeline.results.manifest import manifest

FIELDS = {
    "tile_size", "patch_size", "min_points", "save_dense_tiles", "dense_voxel", "map_bounds",
    "n_tiles_grid", "patches", "n_valid_patches", "n_skipped_tiles",
}  # fmt: skip
PATCH_FIELDS = {
    "patch_id", "tile_idx", "tile_center", "n_original_points", "n_sampled_points", "file", "dense_file",
}  # fmt: skip
CELLS = {(0, 0, 0): 600, (2, 1, 1): 512, (1, 0, 0): 511}
POINTS = np.concatenate([in_tile(*cell, count) for cell, count in CELLS.items()])


@pytest.fixture
def listing() -> dict[str, Any]:
    tiles = cut(POINTS, grid_of(3, 2, 2), min_points=512)
    made = manifest(POINTS, tiles, patch_size=4096, min_points=512, voxel_size=0.05)
    read: dict[str, Any] = json.loads(json.dumps(made))
    return read


def test_the_fields_are_those_of_table_a1_and_where_the_grid_begins(listing: dict[str, Any]) -> None:
    assert set(listing) == FIELDS | {"tile_origin", "tile_lowest_idx"}
    assert all(set(patch) == PATCH_FIELDS for patch in listing["patches"])


def test_the_api_describes_it_as_it_is(listing: dict[str, Any]) -> None:
    assert Manifest.model_validate(listing).model_dump(mode="json") == listing


def test_sizes_stand_as_given(listing: dict[str, Any]) -> None:
    assert listing["tile_size"] == [1.5, 1.5, 1.0]
    assert (listing["patch_size"], listing["min_points"], listing["dense_voxel"]) == (4096, 512, 0.05)
    assert listing["save_dense_tiles"] is False


def test_a_detector_without_patches_says_nothing_of_their_size() -> None:
    tiles = cut(POINTS, grid_of(3, 2, 2), min_points=512)
    listing = manifest(POINTS, tiles, patch_size=None, min_points=512, voxel_size=0.05)
    assert listing["patch_size"] is None
    assert {patch["n_sampled_points"] for patch in listing["patches"]} == {None}


def test_bounds_are_those_of_every_point_of_the_map(listing: dict[str, Any]) -> None:
    assert listing["map_bounds"]["min"] == pytest.approx(POINTS.min(axis=0).tolist())
    assert listing["map_bounds"]["max"] == pytest.approx(POINTS.max(axis=0).tolist())


def test_tile_2_1_1_is_listed_with_its_place_and_points(listing: dict[str, Any]) -> None:
    first, last = listing["patches"]
    assert first["patch_id"] == "tile_000_000_000"
    assert last == {
        "patch_id": "tile_002_001_001",
        "tile_idx": [2, 1, 1],
        "tile_center": [13.75, -0.75, 2.0],
        "n_original_points": 512,
        "n_sampled_points": 4096,
        "file": None,
        "dense_file": None,
    }


def test_valid_and_skipped_tiles_add_up_to_the_grid(listing: dict[str, Any]) -> None:
    assert listing["n_tiles_grid"] == [3, 2, 2]
    assert listing["n_valid_patches"] == len(listing["patches"]) == 2
    assert listing["n_valid_patches"] + listing["n_skipped_tiles"] == 12


def test_the_grid_can_be_rebuilt_from_the_manifest(listing: dict[str, Any]) -> None:
    again = cut(POINTS, _rebuilt(listing), min_points=listing["min_points"])
    assert again.indices.tolist() == [patch["tile_idx"] for patch in listing["patches"]]


def test_the_grid_of_a_map_that_grew_below_its_origin_can_be_rebuilt_too() -> None:
    points = np.concatenate([in_tile(-2, 0, -1, 600), POINTS])
    tiles = cut(points, grown(grid_of(3, 2, 2), points), min_points=512)
    listing = manifest(points, tiles, patch_size=4096, min_points=512, voxel_size=0.05)
    assert listing["tile_lowest_idx"] == [-2, 0, -1]
    assert listing["n_tiles_grid"] == [5, 2, 3]
    assert listing["patches"][0]["patch_id"] == "tile_-02_000_-01"
    again = cut(points, _rebuilt(listing), min_points=512)
    assert again.indices.tolist() == [patch["tile_idx"] for patch in listing["patches"]]
    assert again.indices.tolist() == [[-2, 0, -1], [0, 0, 0], [2, 1, 1]]


def _rebuilt(listing: dict[str, Any]) -> TileGrid:
    return TileGrid(
        origin=np.array(listing["tile_origin"]),
        size=np.array(listing["tile_size"]),
        shape=tuple(listing["n_tiles_grid"]),
        lowest=tuple(listing["tile_lowest_idx"]),
    )
