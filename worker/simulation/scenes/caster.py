"""Rays and distances against triangles: the only file here that speaks to Open3D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from worker.cloud.types import Bools, Floats


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Hits:
    """Where rays met the scene."""

    ranges: Floats  #: (N,) metres, inf where they met nothing
    cosines: Floats  #: (N,) cosine of the angle between ray and normal; 0 where they met nothing
    object_ids: NDArray[np.int32]  #: (N,) 0 where they met nothing
    normals: Floats | None = None  #: (N, 3) unit length, of the triangles; any where they met nothing


class Caster:
    """Open3D's RaycastingScene over all triangles of a scene, and whose triangle each is."""

    def __init__(self, vertices: Floats, triangles: NDArray[np.int32], owners: NDArray[np.int32]) -> None:
        """Take `vertices` (V, 3) metres, `triangles` (F, 3), `owners` (F,) object ids."""
        self._owners = owners
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(triangles.astype(np.uint32)),
        )

    def cast(self, origins: Floats, rays: Floats) -> Hits:
        """Cast rays (N, 3), unit length, from one origin (3,) or one each (N, 3), world frame; all in one call."""
        packed = np.empty((len(rays), 6), dtype=np.float32)
        packed[:, :3], packed[:, 3:] = origins, rays
        answer = self._scene.cast_rays(o3d.core.Tensor.from_numpy(packed))
        ranges = answer["t_hit"].numpy().astype(np.float64)
        hit = np.isfinite(ranges)
        # Open3D marks a miss with the largest uint32, which is no index.
        triangle = np.where(hit, answer["primitive_ids"].numpy(), 0).astype(np.int64)
        normals = answer["primitive_normals"].numpy()
        cosines = np.abs(np.einsum("ij,ij->i", normals, packed[:, 3:]))
        return Hits(
            ranges=ranges,
            cosines=np.where(hit, cosines, 0.0).astype(np.float64),
            object_ids=np.where(hit, self._owners[triangle], 0).astype(np.int32),
            normals=normals,
        )

    def distances(self, points: Floats) -> Floats:
        """Return the metres (N,) from each point (N, 3) to the nearest surface."""
        query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
        distances: Floats = self._scene.compute_distance(query).numpy().astype(np.float64)
        return distances


def nearest(first: Hits, second: Hits) -> Hits:
    """Return of two answers to the same rays (N,) the nearer one of each; the normals are the first's."""
    return chosen(second.ranges < first.ranges, second, first)


def chosen(where: Bools, these: Hits, others: Hits) -> Hits:
    """Return `these` answers where asked for (N,), and the others elsewhere; the normals are the others'."""
    return Hits(
        ranges=np.where(where, these.ranges, others.ranges),
        cosines=np.where(where, these.cosines, others.cosines),
        object_ids=np.where(where, these.object_ids, others.object_ids),
        normals=others.normals,
    )
