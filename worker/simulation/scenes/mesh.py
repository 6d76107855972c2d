"""Triangle meshes of simple solids, and the rigid moves that place them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Floats, Matrix4


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Mesh:
    """A triangle soup; closed solids, normals outward."""

    vertices: Floats  #: (V, 3) metres
    triangles: NDArray[np.int32]  #: (F, 3) indices into vertices

    @property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest corner of the axis-aligned box around the mesh."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def placed(self, target_from_source: Matrix4) -> Mesh:
        """Return the mesh in the target frame."""
        vertices = self.vertices @ target_from_source[:3, :3].T + target_from_source[:3, 3]
        return Mesh(vertices=vertices, triangles=self.triangles)

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw: float = 0.0) -> Mesh:
        """Return the mesh turned by `yaw` degrees about z, then shifted."""
        return self.placed(rigid(x, y, z, yaw=yaw))


def rigid(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> Matrix4:
    """Return target_from_source (4, 4): roll about x, pitch about y, yaw about z (degrees), then the shift."""
    angles = np.radians([roll, pitch, yaw])
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    target_from_source = np.eye(4)
    target_from_source[:3, :3] = (
        np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
        @ np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        @ np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    )
    target_from_source[:3, 3] = x, y, z
    return target_from_source


def union(*meshes: Mesh) -> Mesh:
    """Return all meshes as one; where solids overlap, the hidden faces stay (no ray from outside meets them)."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        triangles=np.concatenate(triangles).astype(np.int32),
    )


def box(width: float, depth: float, height: float) -> Mesh:
    """Build a box by its extents along x, y, z; centred in x and y, standing on z = 0."""
    corners = np.array([[x, y, z] for z in (0.0, 1.0) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))]
    return Mesh(
        vertices=corners * np.array([width, depth, height]), triangles=np.array(triangles, dtype=np.int32)
    )


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """Build the axis-aligned box between two corners."""
    size = np.subtract(high, low)
    return box(*size).at((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2])


def turned(profile: list[tuple[float, float]], *, sides: int = 20) -> Mesh:
    """Build the solid that a profile of (radius, z) sweeps about z; its first and last radius should be 0."""
    angles = np.arange(sides) * (2 * np.pi / sides)
    rings = [np.c_[r * np.cos(angles), r * np.sin(angles), np.full(sides, z)] for r, z in profile]
    here = np.arange(sides)
    after = np.roll(here, -1)
    triangles = []
    for ring in range(len(profile) - 1):
        low, high = ring * sides, (ring + 1) * sides
        triangles.append(np.c_[low + here, low + after, high + after])
        triangles.append(np.c_[low + here, high + after, high + here])
    return Mesh(vertices=np.concatenate(rings), triangles=np.concatenate(triangles).astype(np.int32))


def cylinder(radius: float, height: float, *, sides: int = 20) -> Mesh:
    """Build a cylinder with its axis along z, standing on z = 0."""
    return turned([(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)], sides=sides)


def sphere(radius: float, *, sides: int = 16) -> Mesh:
    """Build a ball that stands on z = 0."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    rings = zip(radius * np.cos(angles), radius * (1 + np.sin(angles)), strict=True)
    return turned([(float(abs(r)), float(z)) for r, z in rings], sides=sides)
