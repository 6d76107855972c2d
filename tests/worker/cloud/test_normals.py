from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from worker.cloud import normals as module
from worker.cloud.normals import estimate_normals


def _wall(spacing: float) -> np.ndarray:
    y, z = np.meshgrid(np.arange(0, 3, spacing), np.arange(0, 3, spacing))
    x = np.random.default_rng(0).normal(0, 0.005, y.size)
    return np.column_stack([x, y.ravel(), z.ravel()])


@pytest.mark.parametrize("spacing", [0.05, 0.14])
def test_normals_of_a_wall_point_across_it_also_where_points_are_sparse(spacing: float) -> None:
    normals = estimate_normals(_wall(spacing), radius=0.1, max_neighbors=30)
    assert np.abs(normals[:, 0]).mean() > 0.97
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(len(normals)), abs=1e-5)


def test_a_handful_of_points_gets_normals_of_unit_length() -> None:
    normals = estimate_normals(np.eye(3), radius=0.1, max_neighbors=30)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(3))


def _corner(sigma: float) -> np.ndarray:
    """Three walls that meet, with what a scanner adds to them, sparse on one, and some points in the air."""
    rng = np.random.default_rng(2)
    walls = [_wall(0.05), _wall(0.14)[:, [1, 0, 2]], _wall(0.03)[:, [1, 2, 0]]]
    cloud = np.concatenate([*walls, rng.uniform(0, 3, (500, 3))])
    return rng.permutation(cloud + rng.normal(0, sigma, cloud.shape)) + 40.0


def _apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles between axes, degrees."""
    sines = np.linalg.norm(np.cross(one.astype(np.float64), other.astype(np.float64)), axis=1)
    return np.degrees(np.arcsin(np.clip(sines, 0, 1)))


def _of_open3d(cloud: np.ndarray, radius: float, max_neighbors: int) -> np.ndarray:
    """Estimate normals as Open3D does, over three times the radius where it finds fewer than nine points."""
    both = []
    for reach in (radius, 3 * radius):
        around = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud))
        around.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(reach, max_neighbors))
        both.append(np.asarray(around.normals).copy())
    tree = o3d.geometry.KDTreeFlann(around)
    sparse = np.array([tree.search_hybrid_vector_3d(point, radius, 9)[0] < 9 for point in cloud])
    assert sparse.any()
    return np.where(sparse[:, None], both[1], both[0])


def test_normals_are_those_of_open3d_to_a_thousandth_of_a_degree() -> None:
    cloud = _corner(0.004)
    angles = _apart(
        estimate_normals(cloud, radius=0.1, max_neighbors=30), _of_open3d(cloud, radius=0.1, max_neighbors=30)
    )
    assert angles.max() < 1e-3


def test_points_on_a_line_and_in_one_place_get_normals_of_unit_length_across_them() -> None:
    line = np.column_stack([np.arange(0, 2, 0.02), np.zeros(100), np.zeros(100)])
    normals = estimate_normals(line, radius=0.1, max_neighbors=30)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(100), abs=1e-5)
    assert normals[:, 0] == pytest.approx(np.zeros(100), abs=1e-5)
    place = estimate_normals(np.ones((20, 3)), radius=0.1, max_neighbors=30)
    assert np.linalg.norm(place, axis=1) == pytest.approx(np.ones(20), abs=1e-5)


def test_no_point_has_no_normal() -> None:
    assert estimate_normals(np.empty((0, 3)), radius=0.1, max_neighbors=30).shape == (0, 3)


def test_normals_of_a_large_cloud_are_those_that_it_has_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = _corner(0.004)
    whole = estimate_normals(cloud, radius=0.1, max_neighbors=30)
    monkeypatch.setattr(module, "AT_ONCE", 100)
    blocks = estimate_normals(cloud, radius=0.1, max_neighbors=30)
    assert _apart(whole, blocks).max() < 1e-3
