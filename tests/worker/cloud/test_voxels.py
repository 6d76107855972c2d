from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from worker.cloud import voxels as module
from worker.cloud.voxels import Voxels
from worker.errors import MapFailed


def test_points_of_one_cell_become_their_mean() -> None:
    points = np.array([[0.01, 0.01, 0.01], [0.03, 0.01, 0.01], [0.06, 0.01, 0.01]], np.float32)
    voxels = Voxels.of(points, size=0.05)
    assert voxels.points == pytest.approx(np.array([[0.02, 0.01, 0.01], [0.06, 0.01, 0.01]]))
    assert voxels.counts.tolist() == [2, 1]


def test_cells_are_anchored_at_the_origin_of_the_frame_not_at_the_cloud() -> None:
    cloud = np.random.default_rng(0).uniform(-2, 2, (5000, 3)).astype(np.float32)
    whole = Voxels.of(cloud, size=0.05)
    part = Voxels.of(cloud[cloud[:, 0] > 0.333], size=0.05)
    assert np.isin(part.keys, whole.keys).all()


def test_merging_two_halves_equals_fusing_the_whole() -> None:
    rng = np.random.default_rng(1)
    cloud = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (4000, 3), dtype=np.uint8)
    origin = np.array([3.0, 0.0, 0.0])
    whole = Voxels.of(cloud, size=0.1, origin=origin, colors=colors)
    halves = [
        Voxels.of(cloud[part], size=0.1, origin=origin, colors=colors[part])
        for part in (slice(0, 1500), slice(1500, None))
    ]
    merged = halves[0].merged(halves[1])
    assert (merged.keys == whole.keys).all()
    assert merged.points == pytest.approx(whole.points, abs=1e-6)
    assert merged.colors is not None and whole.colors is not None
    assert np.abs(merged.colors.astype(int) - whole.colors).max() <= 1


def test_merging_with_an_uncoloured_cloud_leaves_no_colours() -> None:
    points = np.zeros((2, 3), np.float32)
    coloured = Voxels.of(points, size=0.1, colors=np.full((2, 3), 9, np.uint8))
    assert coloured.merged(Voxels.of(points, size=0.1)).colors is None


def test_a_cell_seen_from_both_sides_has_no_direction() -> None:
    point = np.zeros((1, 3), np.float32)
    left = Voxels.of(point, size=0.1, origin=np.array([-2.0, 0.0, 0.0]))
    right = Voxels.of(point, size=0.1, origin=np.array([2.0, 0.0, 0.0]))
    assert left.views == pytest.approx(np.array([[-1.0, 0.0, 0.0]]))
    assert left.merged(right).views == pytest.approx(np.zeros((1, 3)))


@pytest.mark.parametrize("far", [60_000.0, -60_000.0])
def test_a_point_beyond_what_the_cells_can_count_is_refused(far: float) -> None:
    with pytest.raises(MapFailed, match="60 km from the map's origin"):
        Voxels.of(np.array([[0.0, far, 0.0]]), size=0.05)


def test_a_cloud_gives_the_same_voxels_whatever_is_sorted_at_once(monkeypatch) -> None:
    rng = np.random.default_rng(2)
    points, colors = rng.uniform(-1, 1, (1000, 3)), rng.integers(0, 256, (1000, 3), np.uint8)
    whole = Voxels.of(points, size=0.25, origin=np.zeros(3), colors=colors)
    monkeypatch.setattr("worker.cloud.voxels._AT_ONCE", 7)
    pieces = Voxels.of(points, size=0.25, origin=np.zeros(3), colors=colors)
    np.testing.assert_array_equal(pieces.keys, whole.keys)
    np.testing.assert_array_equal(pieces.counts, whole.counts)
    np.testing.assert_allclose(pieces.sums, whole.sums)


def test_merging_in_runs_gives_what_merging_at_once_gives_bit_for_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(4)
    clouds = [rng.uniform(-1, 1 + extra, (n, 3)).astype(np.float32) for n, extra in ((4000, 0.0), (900, 2.0))]
    colors = [rng.integers(0, 256, cloud.shape, dtype=np.uint8) for cloud in clouds]
    parts = [
        Voxels.of(cloud, size=0.1, origin=np.array([3.0, 0, 0]), colors=color)
        for cloud, color in zip(clouds, colors, strict=True)
    ]
    nothing = Voxels.of(clouds[0][:0], size=0.1, colors=colors[0][:0])
    for one, other in (parts, parts[::-1], (parts[0], nothing), (nothing, parts[1])):
        whole = one.merged(other)
        means = whole.points, whole.views, whole.colors
        with monkeypatch.context() as patch:
            patch.setattr(module, "_AT_ONCE", 97)
            runs = one.merged(other)
            assert np.array_equal(runs.keys, whole.keys)
            assert np.array_equal(runs.counts, whole.counts)
            assert np.array_equal(runs.sums, whole.sums)
            for found, expected in zip((runs.points, runs.views, runs.colors), means, strict=True):
                assert found is not None and expected is not None
                assert np.array_equal(found, expected)


def test_merging_takes_no_more_memory_than_both_and_their_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted by what NumPy allocates; both are there before."""
    rng = np.random.default_rng(4)
    one, other = (Voxels.of(rng.uniform(-3, 3, (60_000, 3)).astype(np.float32), size=0.05) for _ in range(2))
    monkeypatch.setattr(module, "_AT_ONCE", 2000)
    tracemalloc.start()
    try:
        merged = one.merged(other)
        assert tracemalloc.get_traced_memory()[1] < 1.2 * (
            merged.sums.nbytes + merged.counts.nbytes + merged.keys.nbytes
        )
    finally:
        tracemalloc.stop()
