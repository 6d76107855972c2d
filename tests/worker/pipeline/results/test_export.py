from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.support.tilings import ORIGIN, four_states, in_tile
from tests.support.tools import TESTS, needs_tools, run
from worker.cloud.formats.scan import read_scan
from worker.cloud.voxels import Voxels
from worker.detectors.detector import VoxelScores
from worker.pipeline.results.changes import ChangeSet, TileState
from worker.pipeline.results.export import (
    KIND_COLORS,
    NOT_IN_A_TILE,
    STATE_COLORS,
    ColouredCloud,
    PointKind,
    tile_results,
    write_coloured_cloud,
)
from worker.pipeline.results.objects import ChangeObjects

OUTSIDE = np.add(ORIGIN, [(-0.1, 0.5, 0.5), (0.5, 0.5, 5.0)]).astype(np.float32)
CLOUD = np.concatenate([*(in_tile(i, 0, 0, 1 + i) for i in range(4)), OUTSIDE])
ROW = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3, -1, -1])  # the tile that holds each point of CLOUD


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "cloud.ply"
    write_coloured_cloud(path, CLOUD[:1], CLOUD, four_states())
    return path


def test_the_coloured_cloud_is_read_back_point_for_point(written: Path) -> None:
    assert read_scan(written).points.tolist() == CLOUD.tolist()


def test_each_point_has_the_colour_of_its_tile(written: Path) -> None:
    colors = read_scan(written).colors
    assert colors is not None
    for row, state in enumerate(TileState):
        assert {tuple(color) for color in colors[row == ROW].tolist()} == {STATE_COLORS[state]}
    outside = {tuple(color) for color in colors[ROW == -1].tolist()}
    assert len(outside) == 1
    assert not outside & set(STATE_COLORS.values())


def test_no_two_states_share_a_colour() -> None:
    assert len(set(STATE_COLORS.values())) == len(TileState)


def test_open3d_reads_state_and_score_of_each_point(written: Path) -> None:
    cloud = o3d.t.io.read_point_cloud(written)
    state, score = (
        cloud.point[name].numpy().ravel() for name in ("scalar_tile_state", "scalar_change_score")
    )
    assert state.tolist() == [0, 1, 1, 2, 2, 2, 3, 3, 3, 3, NOT_IN_A_TILE, NOT_IN_A_TILE]
    assert score[:6].tolist() == [0.25, 0.75, 0.75, 0.875, 0.875, 0.875]
    assert np.isnan(score[6:]).all()
    assert cloud.point.positions.numpy() == pytest.approx(CLOUD)


def test_a_point_on_a_border_has_the_colour_of_the_upper_tile(tmp_path: Path) -> None:
    border = np.add(ORIGIN, [(1.5, 0.5, 0.5)]).astype(np.float32)
    write_coloured_cloud(tmp_path / "c.ply", border, border, four_states())
    colors = read_scan(tmp_path / "c.ply").colors
    assert colors is not None
    assert tuple(colors[0].tolist()) == STATE_COLORS[TileState.CHANGED]


def test_in_a_map_that_grew_below_its_origin_points_have_the_colours_of_their_own_tiles(
    tmp_path: Path,
) -> None:
    known = four_states()
    tiles = known.pairs.reference
    grown = replace(tiles.grid, lowest=(-2, 0, 0))
    pairs = replace(
        known.pairs,
        reference=replace(tiles, grid=grown, indices=tiles.indices - np.array([2, 0, 0], np.int32)),
    )
    cloud = np.concatenate([in_tile(i - 2, 0, 0, 1) for i in range(5)])  # the last one is of no tile
    write_coloured_cloud(tmp_path / "c.ply", cloud, cloud, replace(known, pairs=pairs))
    state = o3d.t.io.read_point_cloud(tmp_path / "c.ply").point["scalar_tile_state"].numpy().ravel()
    assert state.tolist() == [0, 1, 2, 3, NOT_IN_A_TILE]


VOXEL = 0.05


def _by_voxels() -> tuple[np.ndarray, np.ndarray, ChangeSet]:
    """Map and survey, a point in each of five voxels in a row, and what a detector says of them.

    The map has the first three, the survey the last four: 0 went, 1 stays, 2 could not be judged, 3 came, 4 walked by.
    """
    middles = np.add(ORIGIN, [(0.52 + VOXEL * number, 0.5, 0.5) for number in range(5)])
    points = (np.floor(middles / VOXEL) * VOXEL + VOXEL / 2).astype(np.float32)
    keys = Voxels.keys_of(points, size=VOXEL)
    voxels = VoxelScores(
        keys=keys,
        appeared=np.array([0, 0, 0, 0.75, 0.25], np.float32),
        disappeared=np.array([0.875, 0, 0, 0, 0], np.float32),
        judged=np.array([True, True, False, True, True]),
        moving=np.array([False, False, False, False, True]),
        seen_through=np.ones(5, np.int16),
    )
    objects = ChangeObjects(
        objects=(),
        moving=0,
        voxel_size=VOXEL,
        keys=keys,
        before=np.array([2, 0, 0, 0, 0], np.int32),
        now=np.array([0, 0, 0, 7, 0], np.int32),
    )
    share = np.array([1.0, 0.75, 0.5, 0.25], np.float32)
    counts = np.arange(4, dtype=np.int32)
    known = replace(four_states(), observed_share=share, appeared=counts, disappeared=counts)
    return points[:3], points[1:], replace(known, voxels=voxels, objects=objects)


@pytest.fixture
def by_voxels(tmp_path: Path) -> Path:
    reference, current, changes = _by_voxels()
    write_coloured_cloud(tmp_path / "voxels.ply", reference, current, changes)
    return tmp_path / "voxels.ply"


def test_with_objects_each_point_bears_its_own_kind_score_and_number(by_voxels: Path) -> None:
    cloud = o3d.t.io.read_point_cloud(by_voxels).point
    kind, score, number, state = (
        cloud[f"scalar_{name}"].numpy().ravel()
        for name in ("kind", "change_score", "object_id", "tile_state")
    )
    lost = PointKind.DISAPPEARED
    assert kind.tolist() == [
        PointKind.UNCHANGED,
        PointKind.NOT_JUDGED,
        PointKind.APPEARED,
        PointKind.MOVING,
        lost,
    ]
    assert number.tolist() == [0, 0, 7, 0, 2]
    assert score[[0, 2, 3, 4]].tolist() == [0.0, 0.75, 0.25, 0.875]
    assert np.isnan(score[1])
    assert state.tolist() == [TileState.UNCHANGED] * 5
    assert (kind.dtype, number.dtype) == (np.uint8, np.int32)


def test_the_header_tells_what_the_numbers_mean(written: Path, by_voxels: Path) -> None:
    tiles, voxels = (path.read_bytes().split(b"end_header")[0].decode() for path in (written, by_voxels))
    assert (
        "comment scalar_tile_state: 0 unchanged, 1 changed, 2 inconsistent, 3 unobserved, 255 outside"
        in tiles
    )
    assert "comment scalar_kind: 0 unchanged, 1 appeared, 2 disappeared, 3 not judged, 4 moving" in voxels
    for header in (tiles, voxels):
        told = {line.split()[1].rstrip(":") for line in header.splitlines() if line.startswith("comment s")}
        kept = {line.split()[2] for line in header.splitlines() if line.startswith("property")}
        assert told == {name for name in kept if name.startswith("scalar_")}


@needs_tools
@pytest.mark.slow
def test_meshlab_reads_the_score_of_each_point(by_voxels: Path) -> None:
    seen = json.loads(run("python", TESTS / "read_cloud.py", by_voxels))
    assert seen == {"points": 5, "quality": [0.0, None, 0.75, 0.25, 0.875]}


def test_with_objects_the_points_that_the_map_lost_are_in_the_cloud(by_voxels: Path) -> None:
    reference, current, _ = _by_voxels()
    assert read_scan(by_voxels).points.tolist() == [*current.tolist(), reference[0].tolist()]


def test_with_objects_each_kind_has_a_colour_of_its_own(by_voxels: Path) -> None:
    colors = read_scan(by_voxels).colors
    assert colors is not None
    order = (
        PointKind.UNCHANGED,
        PointKind.NOT_JUDGED,
        PointKind.APPEARED,
        PointKind.MOVING,
        PointKind.DISAPPEARED,
    )
    assert [tuple(color) for color in colors.tolist()] == [KIND_COLORS[kind] for kind in order]
    assert len(set(KIND_COLORS.values())) == len(PointKind)


def test_with_voxels_a_tile_tells_what_could_be_judged_and_what_changed() -> None:
    _, _, changes = _by_voxels()
    result = tile_results(changes)[1]
    assert (result.observed_share, result.appeared, result.disappeared) == (0.75, 1, 1)
    plain = tile_results(four_states())[1]
    assert (plain.observed_share, plain.appeared, plain.disappeared) == (None, None, None)


def test_an_unobserved_tile_of_which_a_part_was_judged_has_a_score() -> None:
    known = four_states()
    probabilities = known.probabilities.copy()
    probabilities[3] = (0.875, 0.125, 0.0)
    result = tile_results(replace(known, probabilities=probabilities))[3]
    assert (result.state, result.score) == ("unobserved", 0.125)


def test_a_changed_tile_as_a_client_is_told_of_it() -> None:
    result = tile_results(four_states())[1]
    assert (result.tile_id, result.tile_index) == ("tile_001_000_000", (1, 0, 0))
    assert (result.lower, result.upper) == ((11.5, -3.0, 0.5), (13.0, -1.5, 1.5))
    assert (result.state, result.score, result.probabilities) == ("changed", 0.75, (0.25, 0.75, 0.0))
    assert (result.n_reference, result.n_current) == (700, 710)


def test_an_unobserved_tile_has_no_score_but_its_points_are_counted() -> None:
    result = tile_results(four_states())[3]
    assert (result.state, result.score, result.probabilities) == ("unobserved", None, None)
    assert (result.n_reference, result.n_current) == (900, 3)


def test_there_is_a_result_for_every_tile() -> None:
    assert [result.state for result in tile_results(four_states())] == [
        "unchanged",
        "changed",
        "inconsistent",
        "unobserved",
    ]


def test_as_laz_the_cloud_has_the_same_points_colours_and_scalars(tmp_path: Path, by_voxels: Path) -> None:
    cloud = ColouredCloud.of(*_by_voxels())
    cloud.write_laz(tmp_path / "voxels.laz")
    las, ply = laspy.read(tmp_path / "voxels.laz"), o3d.t.io.read_point_cloud(by_voxels).point
    assert_allclose(las.xyz, ply["positions"].numpy(), atol=5.1e-4)
    assert_array_equal(np.stack([las.red, las.green, las.blue], axis=1) // 257, ply["colors"].numpy())
    for name in ("change_score", "tile_state", "kind", "object_id"):
        assert_array_equal(las[name], ply[f"scalar_{name}"].numpy().ravel())
        described = las.point_format.dimension_by_name(name).description
        assert described.rstrip("\0")
