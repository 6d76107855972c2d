"""The writer of LAZ: read back by laspy, and by our own reader."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from worker.cloud.formats.laz import write_laz
from worker.cloud.formats.scan import read_scan

POINTS = np.array([[0, 0, 0], [-1.2345, 2, 3], [12.3456, -7, 0.5]], np.float32)
COLORS = np.array([[255, 0, 128], [1, 2, 3], [213, 94, 0]], np.uint8)


def test_points_colours_and_scalars_are_read_back(tmp_path):
    path = tmp_path / "cloud.laz"
    scalars: dict[str, np.ndarray] = {
        "change_score": np.array([0.25, np.nan, 1], np.float32),
        "tile_state": np.array([0, 3, 255], np.uint8),
        "kind": np.array([0, 1, 4], np.uint8),
        "object_id": np.array([0, 70_000, 3], np.int32),
    }
    write_laz(path, POINTS, colors=COLORS, scalars=scalars, meanings={"kind": "what it is"})
    las = laspy.read(path)
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 7)
    assert las.header.global_encoding.wkt
    assert_allclose(las.xyz, POINTS, atol=5.1e-4)
    assert_array_equal(np.stack([las.red, las.green, las.blue], axis=1), COLORS.astype(int) * 257)
    for name, values in scalars.items():
        assert_array_equal(las[name], values)
        assert las[name].dtype == values.dtype
    assert las.point_format.dimension_by_name("kind").description == "what it is"
    scan = read_scan(path, apart=False)
    assert_allclose(scan.points, POINTS, atol=5.1e-4)
    assert_array_equal(scan.colors, COLORS)


def test_a_cloud_without_colours_and_one_without_points_are_written(tmp_path):
    write_laz(tmp_path / "plain.laz", POINTS)
    assert laspy.read(tmp_path / "plain.laz").header.point_format.id == 6
    write_laz(tmp_path / "empty.laz", POINTS[:0], colors=COLORS[:0])
    assert len(laspy.read(tmp_path / "empty.laz").points) == 0


def test_more_points_than_are_written_at_once_are_all_there(tmp_path, monkeypatch):
    monkeypatch.setattr("worker.cloud.formats.laz._AT_ONCE", 2)
    write_laz(tmp_path / "cloud.laz", POINTS, scalars={"kind": np.array([1, 2, 3], np.uint8)})
    las = laspy.read(tmp_path / "cloud.laz")
    assert_allclose(las.xyz, POINTS, atol=5.1e-4)
    assert_array_equal(las["kind"], [1, 2, 3])


def test_a_scalar_of_another_length_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"\[2\] values for 3 points"):
        write_laz(tmp_path / "cloud.laz", POINTS, scalars={"kind": np.zeros(2)})
    assert not list(tmp_path.iterdir())
