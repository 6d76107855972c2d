"""One content: bytes, axes and steps, against the standards' own words."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.tilesets import decoded
from worker.cloud.tilesets.glb import Quantisation, encode_points

POINTS = np.array([[10, 20, 30], [12, 20, 30], [10, 21, 30], [10, 20, 30.5]], np.float32)


def test_a_point_above_another_is_above_it_in_gltf_whose_y_axis_points_up() -> None:
    content = decoded(encode_points(POINTS))
    matrix = np.array(content.document["nodes"][0]["matrix"]).reshape(4, 4).T
    steps = content.attributes["POSITION"].astype(float)
    gltf = steps @ matrix[:3, :3].T + matrix[:3, 3]
    assert gltf[3] - gltf[0] == pytest.approx([0, 0.5, 0], abs=content.step)
    assert gltf[2] - gltf[0] == pytest.approx([0, 0, -1], abs=content.step)
    assert np.linalg.det(matrix[:3, :3]) > 0  # nothing is mirrored


def test_the_step_is_the_same_along_every_axis_and_the_longest_side_has_65535() -> None:
    grid = Quantisation.of(POINTS)
    assert grid.step == pytest.approx(2 / 65535)
    assert grid.applied(POINTS).max(axis=0).tolist() == [65535, 32768, 16384]


def test_limits_of_positions_are_told_as_gltf_wants_it() -> None:
    document = decoded(encode_points(POINTS)).document
    position = document["accessors"][0]
    assert (position["min"], position["max"]) == ([0, 0, 0], [65535, 32768, 16384])
    assert "KHR_mesh_quantization" in document["extensionsRequired"]


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_chunks_and_columns_begin_at_multiples_of_four(count: int) -> None:
    extra = np.arange(3 * count, dtype=np.uint8).reshape(count, 3)
    points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    for extra_is in ("color", "normal"):
        glb = encode_points(points, extra, extra_is=extra_is)
        assert len(glb) % 4 == 0
        (buffer,) = decoded(glb).document["buffers"]
        assert buffer["byteLength"] == 12 * count


def test_points_at_one_place_are_a_content_too() -> None:
    content = decoded(encode_points(np.full((3, 3), 5, np.float32)))
    assert content.points == pytest.approx(np.full((3, 3), 5.0))


def test_points_far_from_the_origin_keep_half_a_step() -> None:
    far = POINTS + np.array([50_000, -40_000, 0], np.float32)
    content = decoded(encode_points(far))
    assert np.abs(content.points - far).max() <= content.step / 2 + 1e-9
