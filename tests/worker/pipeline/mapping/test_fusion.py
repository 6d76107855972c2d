from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.support.tilings import grid_of
from worker.cloud.types import Colors, Floats
from worker.cloud.voxels import Voxels
from worker.errors import MapFailed
from worker.pipeline.flow import fused_scans
from worker.pipeline.mapping.fusion import current_map, fuse, reference_map
from worker.pipeline.registration.results import RegisteredScan
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.settings import PipelineSettings
from worker.progress import no_progress

SETTINGS = RegistrationSettings()


def scan_of(
    points: np.ndarray, *, colors: Colors | None = None, origin: Floats | None = None
) -> RegisteredScan:
    return RegisteredScan(
        name="scan.pcd",
        points=np.asarray(points, np.float32),
        colors=colors,
        map_from_scan=np.eye(4),
        sensor_origin=origin,
    )


def floor() -> np.ndarray:
    """2 x 2 m at z = 0.02, a point every 2 cm."""
    x, y = np.meshgrid(np.arange(0.01, 2, 0.02), np.arange(0.01, 2, 0.02))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.02)])


def test_points_of_two_scans_in_one_voxel_become_their_mean() -> None:
    a = scan_of(np.array([[0.01, 0.01, 0.01]]))
    b = scan_of(np.array([[0.03, 0.04, 0.01], [0.03, 0.04, 0.04], [0.07, 0.01, 0.01]]))
    fused = fuse([a, b], voxel_size=0.05)
    assert fused.points == pytest.approx(np.array([[0.07 / 3, 0.03, 0.02], [0.07, 0.01, 0.01]]), abs=1e-6)


def test_two_scans_fuse_to_the_same_map_in_either_order() -> None:
    rng = np.random.default_rng(0)
    a, b = (scan_of(rng.uniform(-1, 1, (5000, 3))) for _ in range(2))
    assert fuse([a, b], voxel_size=0.05).points == pytest.approx(fuse([b, a], voxel_size=0.05).points)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 11])
def test_fusing_many_scans_gives_what_merging_them_one_by_one_gives(count: int) -> None:
    """Sums of like size are merged first; nobody may be lost on the way, whatever the sizes."""
    rng = np.random.default_rng(count)
    scans = [
        scan_of(
            rng.uniform(-1, 1, (int(size), 3)) + np.array([number, 0, 0]), origin=np.array([0.0, 0.0, 5.0])
        )
        for number, size in enumerate(rng.integers(10, 3000, count))
    ]
    fused = fuse(iter(scans), voxel_size=0.1)
    one_by_one = functools.reduce(Voxels.merged, (scan.voxels(0.1) for scan in scans))
    assert fused.keys.tolist() == one_by_one.keys.tolist()
    assert fused.counts.tolist() == one_by_one.counts.tolist()
    assert fused.counts.sum() == sum(len(scan.points) for scan in scans)
    assert fused.points == pytest.approx(one_by_one.points, abs=1e-6)
    assert fused.views == pytest.approx(one_by_one.views.astype(np.float32), abs=1e-9)


def test_no_scan_makes_no_map() -> None:
    with pytest.raises(MapFailed, match="no scan is left"):
        fuse([], voxel_size=0.05)


def test_a_floor_seen_from_above_has_normals_up_and_seen_from_below_down() -> None:
    for height, up in ((1.0, 1.0), (-1.0, -1.0)):
        scan = scan_of(floor(), origin=np.array([1.0, 1.0, height]))
        reference = reference_map(fuse([scan], voxel_size=0.05), grid=grid_of(1, 1, 1), settings=SETTINGS)
        assert reference.normals == pytest.approx(np.tile([0, 0, up], (len(reference.points), 1)), abs=1e-3)
        assert reference.oriented.all()


def test_a_floor_seen_from_nowhere_known_is_not_oriented() -> None:
    reference = reference_map(
        fuse([scan_of(floor())], voxel_size=0.05), grid=grid_of(1, 1, 1), settings=SETTINGS
    )
    assert not reference.oriented.any()
    assert np.abs(reference.normals[:, 2]) == pytest.approx(np.ones(len(reference.points)), abs=1e-3)


def test_the_reference_keeps_points_colours_and_the_voxel_size() -> None:
    colors = np.tile(np.array([[10, 20, 30]], np.uint8), (len(floor()), 1))
    fused = fuse([scan_of(floor(), colors=colors)], voxel_size=0.1)
    reference = reference_map(fused, grid=grid_of(1, 1, 1), settings=SETTINGS)
    assert len(reference.points) == 20 * 20
    assert reference.voxel_size == 0.1
    assert reference.colors is not None
    assert reference.colors.tolist() == [[10, 20, 30]] * 400
    assert (reference.points.dtype, reference.normals.dtype) == (np.dtype(np.float32), np.dtype(np.float32))


def test_the_maps_surface_is_what_was_fused() -> None:
    reference = reference_map(
        fuse([scan_of(floor())], voxel_size=0.05), grid=grid_of(1, 1, 1), settings=SETTINGS
    )
    surface = reference.surface()
    distance, index = surface.nearest(reference.points.astype(np.float64))
    assert distance.max() == 0
    assert index.tolist() == list(range(len(reference.points)))


def test_the_current_map_is_fused_in_the_voxels_of_the_reference() -> None:
    reference = reference_map(
        fuse([scan_of(floor())], voxel_size=0.05), grid=grid_of(1, 1, 1), settings=SETTINGS
    )
    current = current_map(fuse([scan_of(floor()[::-1])], voxel_size=reference.voxel_size))
    assert current.points == pytest.approx(reference.points)
    assert current.colors is None


def test_colours_are_kept_only_where_every_scan_has_them() -> None:
    colors = np.full((len(floor()), 3), 7, np.uint8)
    assert current_map(fuse([scan_of(floor(), colors=colors)], voxel_size=0.05)).colors is not None
    mixed = [scan_of(floor(), colors=colors), scan_of(floor())]
    assert current_map(fuse(mixed, voxel_size=0.05)).colors is None


def test_what_fusing_may_hold_is_a_setting_and_the_map_does_not_depend_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    rng = np.random.default_rng(5)
    scans = [scan_of(rng.uniform([number - 1, -1, -1], [number + 1, 1, 1], (4000, 3))) for number in range(5)]
    written: list[int] = []

    def watched() -> Iterator[RegisteredScan]:
        for scan in scans:
            yield scan
            written.append(len(list(tmp_path.rglob("run-*"))))

    tight = PipelineSettings(memory_bytes=200_000)
    fused = fused_scans(watched(), len(scans), tight, no_progress)
    assert written[-1] > 1
    whole = fuse(scans, voxel_size=tight.registration.voxel_size)
    assert fused.keys.tolist() == whole.keys.tolist()
    assert fused.points == pytest.approx(whole.points, abs=1e-6)
