from __future__ import annotations

import numpy as np
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


def test_normals_of_a_large_cloud_are_those_that_it_has_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    cloud = np.concatenate([_wall(0.05), _wall(0.14)[:, [1, 0, 2]], rng.uniform(0, 3, (500, 3))])
    cloud = rng.permutation(cloud)
    whole = estimate_normals(cloud, radius=0.1, max_neighbors=30)
    monkeypatch.setattr(module, "AT_ONCE", 700)
    slabs = estimate_normals(cloud, radius=0.1, max_neighbors=30)
    alike = np.abs(np.einsum("ij,ij->i", whole, slabs))
    assert (
        alike > 1 - 1e-5
    ).mean() > 0.995  # the rest have neighbours at the same distance, or a sphere of them
