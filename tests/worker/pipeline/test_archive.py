"""Stage values come back from disk as they were, and those that release 0.1 wrote too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.release_0_1 import current_of_0_1, reference_of_0_1, scan_of_0_1, tiles_of_0_1
from tests.support.rooms import scores_of
from tests.support.tilings import grid_of, in_tile, row_of
from tests.worker.cloud.test_npz import assert_same
from worker.cloud import npz
from worker.cloud.poses import exponential
from worker.cloud.tiling import TilePairs, grown
from worker.detectors.detector import Detection, VoxelScores
from worker.pipeline import archive
from worker.pipeline.mapping.fusion import CurrentMap, ReferenceMap
from worker.pipeline.registration.results import RegisteredScan

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(7, 3)).astype(np.float32)
COLORS = RNG.integers(0, 256, (7, 3)).astype(np.uint8)
NAN = (float("nan"),) * 3


def reference_of(colors: np.ndarray | None) -> ReferenceMap:
    """A map whose grid grew below zero."""
    return ReferenceMap(
        points=POINTS,
        normals=-POINTS,
        oriented=POINTS[:, 0] > 0,
        colors=colors,
        voxel_size=0.05,
        grid=grown(grid_of(1, 1, 1), np.concatenate([in_tile(-2, 0, 0, 9), in_tile(0, 0, 0, 9)])),
    )


def scan_of(colors: np.ndarray | None, origin: np.ndarray | None) -> RegisteredScan:
    return RegisteredScan(
        name="now.pcd",
        points=POINTS,
        colors=colors,
        map_from_scan=exponential(np.array([0, 0, 1, 2, 3, 4.0])),
        sensor_origin=origin,
    )


@pytest.mark.parametrize("colors", [COLORS, None])
def test_a_reference_comes_back_equal(tmp_path: Path, colors: np.ndarray | None) -> None:
    reference = reference_of(colors)
    assert reference.grid.lowest == (-2, 0, 0)
    npz.save(tmp_path / "r.npz", reference)
    assert_same(reference, archive.load_reference(tmp_path / "r.npz"))


@pytest.mark.parametrize("colors", [COLORS, None])
def test_a_current_map_comes_back_equal(tmp_path: Path, colors: np.ndarray | None) -> None:
    npz.save(tmp_path / "c.npz", CurrentMap(points=POINTS, colors=colors))
    assert_same(CurrentMap(points=POINTS, colors=colors), npz.load(tmp_path / "c.npz", CurrentMap))


@pytest.mark.parametrize("current", [(5, 0, 9), (0, 0, 0), (1, 2, 0)])
def test_pairs_come_back_equal_with_empty_tiles_in_any_place(
    tmp_path: Path, current: tuple[int, ...]
) -> None:
    pairs = row_of([6, 1, 8], current, observed=[True, False, True])
    npz.save(tmp_path / "p.npz", pairs)
    assert_same(pairs, npz.load(tmp_path / "p.npz", TilePairs))


@pytest.mark.parametrize(
    "voxels",
    [
        None,
        VoxelScores(
            keys=np.arange(2),
            appeared=POINTS[0, :2],
            disappeared=POINTS[1, :2],
            judged=np.ones(2, bool),
            moving=np.zeros(2, bool),
            seen_through=np.ones(2, np.int16),
        ),
    ],
)
def test_scores_come_back_equal_with_nan_and_with_voxels_where_there_are_any(
    tmp_path: Path, voxels: VoxelScores | None
) -> None:
    detection = Detection(probabilities=scores_of((0.1, 0.2, 0.7), NAN).probabilities, voxels=voxels)
    npz.save(tmp_path / "s.npz", detection)
    assert_same(detection, npz.load(tmp_path / "s.npz", Detection))


@pytest.mark.parametrize("colors", [COLORS, None])
@pytest.mark.parametrize("origin", [np.array([1.0, 2.0, 0.3]), None])
def test_a_scan_comes_back_with_its_pose_and_its_sensors_place_where_known(
    tmp_path: Path, origin: np.ndarray | None, colors: np.ndarray | None
) -> None:
    npz.save(tmp_path / "a.npz", scan_of(colors, origin))
    assert_same(scan_of(colors, origin), archive.load_scan(tmp_path / "a.npz"))


@pytest.mark.parametrize("colors", [COLORS, None])
@pytest.mark.parametrize("lowest", [(-2, 0, 0), None])
def test_a_map_of_release_0_1_has_its_grid_from_the_file_of_its_tiles(
    tmp_path: Path, colors: np.ndarray | None, lowest: tuple[int, int, int] | None
) -> None:
    """The grid of a map that never grew says nothing of a lowest index."""
    now = reference_of(colors)
    reference_of_0_1(tmp_path / "reference.npz", now)
    tiles_of_0_1(tmp_path / "tiles.npz", now.tiles(min_points=1), lowest=lowest is not None)
    found = archive.load_reference(tmp_path / "reference.npz", tiles_of_0_1=tmp_path / "tiles.npz")
    if lowest is not None:
        assert_same(now, found)
    assert found.grid.lowest == (lowest or (0, 0, 0))
    with pytest.raises(
        ValueError, match=r"reference\.npz is no file of a ReferenceMap: it has no 'grid\.origin'"
    ):
        archive.load_reference(tmp_path / "reference.npz")


@pytest.mark.parametrize("colors", [COLORS, None])
def test_a_survey_and_a_scan_of_release_0_1_come_back(tmp_path: Path, colors: np.ndarray | None) -> None:
    current, scan = CurrentMap(points=POINTS, colors=colors), scan_of(colors, np.ones(3))
    current_of_0_1(tmp_path / "current.npz", current)
    assert_same(current, npz.load(tmp_path / "current.npz", CurrentMap))
    scan_of_0_1(tmp_path / "now.pcd", scan)
    assert_same(scan, archive.load_scan(tmp_path / "now.pcd"))
    probabilities = scores_of((0.1, 0.2, 0.7), NAN).probabilities
    np.savez(tmp_path / "scores.npz", probabilities=probabilities)
    assert_same(Detection(probabilities=probabilities), npz.load(tmp_path / "scores.npz", Detection))
