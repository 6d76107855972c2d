"""Which tiles truly changed between two scenes, from their surfaces: no scan and no noise is involved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import TileGrid
from worker.cloud.types import Bools, Floats, Indices, Matrix4
from worker.simulation.scenes.mesh import Mesh
from worker.simulation.scenes.scene import ChangeKind, Scene, SceneObject

CELL = 0.05  #: metres, the voxel of the fused maps
SAMPLES_PER_M2 = 4 / 0.025**2  #: four in each square of 2.5 cm, so that hardly a cell is missed
FAR = 0.075  #: metres; a surface this near to one of the other visit is not new: one and a half voxels
#: Changed cells that make a changed tile: 0.1 m2 of surface, a sheet of A3 paper less a margin.
MIN_CELLS = 40
SEEN_WITHIN = 10.0  #: metres, beyond which hardly a return arrives
KINDS: tuple[ChangeKind, ...] = ("add", "remove", "move")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TileTruth:
    """The truth about every tile of a grid."""

    grid: TileGrid
    cells: NDArray[np.int32]  #: (I, J, K, 3) changed cells of 5 cm, by kind of change as in KINDS
    min_cells: int = MIN_CELLS

    @property
    def changed(self) -> Bools:
        """(I, J, K) whether the tile truly changed."""
        enough: Bools = self.cells.sum(axis=-1) >= self.min_cells
        return enough

    def cells_of(self, indices: Indices) -> NDArray[np.int32]:
        """Return the changed cells of the tiles at these indices (T, 3), by kind of change: (T, 3), 0 off the grid."""
        at = self.grid.cells(indices)
        return np.where(at[:, None] >= 0, self.cells.reshape(-1, len(KINDS))[at], 0)

    def of(self, indices: Indices) -> Bools:
        """Tell whether the tiles at these indices (T, 3) truly changed: (T,)"""
        enough: Bools = self.cells_of(indices).sum(axis=1) >= self.min_cells
        return enough


def changed_tiles(
    before: Scene,
    after: Scene,
    grid: TileGrid,
    *,
    min_cells: int = MIN_CELLS,
    sensors_before: Sequence[Matrix4] = (),
    sensors_after: Sequence[Matrix4] = (),
) -> TileTruth:
    """Count, in each tile, the cells with a surface that exists in one visit only.

    An added object counts where it stands, a removed one where it stood, a moved one in both places. Surfaces
    within 7.5 cm of the other visit's count as unchanged, so contact faces drop out by themselves, and what an
    object hides or uncovers behind it does not count. With sensor poses (world_from_sensor) only surfaces count
    that a straight line from one of them reaches, in the visit in which they exist.
    """
    cells = np.zeros((*grid.shape, len(KINDS)), dtype=np.int32)
    old = {item.name: item for item in before.objects}
    new = {item.name: item for item in after.objects}
    edited = {name for name in old.keys() & new.keys() if not same_place(old[name], new[name])}
    for kind, names, own, other, sensors in (
        ("remove", old.keys() - new.keys(), before, after, sensors_before),
        ("move", edited, before, after, sensors_before),
        ("add", new.keys() - old.keys(), after, before, sensors_after),
        ("move", edited, after, before, sensors_after),
    ):
        if names:
            surfaces = [own[name].mesh for name in sorted(names)]
            cells[..., KINDS.index(kind)] += _new_cells(surfaces, own, other, sensors, grid)
    return TileTruth(grid=grid, cells=cells, min_cells=min_cells)


def true_changes(
    before: Scene,
    after: Scene,
    grid: TileGrid,
    *,
    map_from_world: Matrix4,
    first: Sequence[Matrix4],
    second: Sequence[Matrix4],
) -> tuple[TileTruth, TileTruth]:
    """Return what exists in one visit only, and of that what a sensor could see.

    The scenes are in the world frame, the grid in the map's, and so are the sensors of both visits (map_from_sensor).
    """
    old, new = (scene.placed(map_from_world) for scene in (before, after))
    exists = changed_tiles(old, new, grid)
    if not exists.cells.any():
        return exists, exists
    return exists, changed_tiles(old, new, grid, sensors_before=first, sensors_after=second)


def sampled(mesh: Mesh, rng: np.random.Generator) -> Floats:
    """Draw points uniformly on the surface: (N, 3)"""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    counts = rng.poisson(areas * SAMPLES_PER_M2)
    u, v = np.sqrt(rng.random(counts.sum())), rng.random(counts.sum())
    a, b, c = (np.repeat(corner, counts, axis=0) for corner in (a, b, c))
    points: Floats = a * (1 - u)[:, None] + b * (u * (1 - v))[:, None] + c * (u * v)[:, None]
    return points


def _new_cells(
    surfaces: list[Mesh], own: Scene, other: Scene, sensors: Sequence[Matrix4], grid: TileGrid
) -> NDArray[np.int64]:
    """Count, in each tile, the cells of these surfaces that the other scene does not have: (I, J, K)"""
    rng = np.random.default_rng(0)
    points = np.concatenate([sampled(mesh, rng) for mesh in surfaces])
    distance = other.caster.distances(points)
    points = points[distance > FAR]
    if len(sensors):
        points = points[_reached(points, own, sensors)]
    voxels = np.unique(np.floor((points - grid.origin) / CELL).astype(np.int64), axis=0)
    tiles = grid.locate(grid.origin + CELL * (voxels + 0.5))
    return np.bincount(tiles[tiles >= 0], minlength=math.prod(grid.shape)).reshape(grid.shape)


def _reached(points: Floats, scene: Scene, sensors: Sequence[Matrix4]) -> Bools:
    """Tell whether a straight line from any sensor ends on each point: (N,)"""
    reached = np.zeros(len(points), dtype=bool)
    for world_from_sensor in sensors:
        rays = points - world_from_sensor[:3, 3]
        distance = np.linalg.norm(rays, axis=1)
        hits = scene.caster.cast(world_from_sensor[:3, 3], rays / np.maximum(distance, 1e-9)[:, None])
        reached |= (hits.ranges > distance - 0.02) & (distance < SEEN_WITHIN)
    return reached


def same_place(a: SceneObject, b: SceneObject) -> bool:
    """Tell whether two states of a thing are the same solid at the same place."""
    return a.mesh.vertices.shape == b.mesh.vertices.shape and np.allclose(a.mesh.vertices, b.mesh.vertices)
