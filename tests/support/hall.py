"""A made hall of any size, and what a scanner on a tripod sees in it: as many points as wanted, in no time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from worker.cloud.types import Floats, Matrix4, Points
from worker.simulation.scenes import rigid

PITCH, RANGE = 8.0, 10.0  #: metres, from one stop to the next, and how far a scan sees
_HEIGHT, _EYE, _NEAR = 4.0, 1.5, 0.8  # metres; of the hall, of the scanner, and from where on it sees
_DENSITY = 600.0  # points a square metre
_NOISE = 0.005  # metres, sigma along the ray
_PANELS, _THINGS = 3, 8  # of each cell
_CLEAR = 1.2  # metres around each stop
POINTS_A_CELL = 70_000  #: voxels of 5 cm that a stop adds to the map, about


@dataclass(frozen=True, kw_only=True)
class Hall:
    """Cells with panels and things at random, under one roof; a stop in the middle of each."""

    cells: int  #: along a side
    boxes: NDArray[np.float64]  #: (B, 2, 3) lowest and highest corners, metres
    _caster: list[o3d.t.geometry.RaycastingScene] = field(default_factory=list)

    @classmethod
    def of(cls, points: float, *, seed: int = 11) -> Hall:
        """Return a hall of which a map has about so many points."""
        cells = max(round((points / POINTS_A_CELL) ** 0.5), 1)
        rng, side = np.random.default_rng(seed), cells * PITCH
        outer = [
            _box([0, 0, -0.1], [side, side, 0.0]),
            _box([0, 0, _HEIGHT], [side, side, _HEIGHT + 0.1]),
            *(_box([low, 0, 0], [low + 0.1, side, _HEIGHT]) for low in (-0.1, side)),
            *(_box([0, low, 0], [side, low + 0.1, _HEIGHT]) for low in (-0.1, side)),
        ]
        corners = [np.array([*divmod(number, cells), 0]) * PITCH for number in range(cells**2)]
        inner = [box for corner in corners for box in _furnished(rng, corner)]
        return cls(cells=cells, boxes=np.stack([*outer, *inner]))

    def with_crate(self, x: float, y: float) -> Hall:
        """Return the same hall with a crate of a cubic metre more, around (x, y)."""
        crate = _box([x - 0.5, y - 0.5, 0.0], [x + 0.5, y + 0.5, 1.0])
        return replace(self, boxes=np.concatenate([self.boxes, crate[None]]), _caster=[])

    def stop(self, number: int, *, aside: float = 0.0, yaw: float = 0.0) -> Matrix4:
        """Return map_from_sensor of a stop, some metres aside and turned by `yaw` degrees."""
        x, y = (np.array(divmod(number, self.cells)) + 0.5) * PITCH
        return rigid(x + aside, y - aside, _EYE, yaw=yaw)

    def scan(self, map_from_sensor: Matrix4, *, seed: int) -> Points:
        """Return what is seen (N, 3), float32, metres, sensor frame: evenly over all surfaces in sight."""
        rng, eye = np.random.default_rng([seed, 5]), map_from_sensor[:3, 3]
        near = (self.boxes[:, 0] < eye + RANGE).all(axis=1) & (self.boxes[:, 1] > eye - RANGE).all(axis=1)
        window = np.stack([eye - RANGE, eye + RANGE])
        points = np.concatenate([_sampled(rng, box, window) for box in self.boxes[near]])
        away = points - eye
        ranges = np.linalg.norm(away, axis=1)
        within = (ranges < RANGE) & (ranges > _NEAR)
        away, ranges = away[within], ranges[within]
        rays = away / ranges[:, None]
        met = self._met(eye, rays)
        seen = met > ranges - 0.01
        noisy = rays[seen] * (ranges[seen] + rng.normal(0, _NOISE, int(seen.sum())))[:, None]
        return (noisy @ map_from_sensor[:3, :3]).astype(np.float32)

    def _met(self, eye: Floats, rays: Floats) -> Floats:
        """Return (N,) metres to the first surface along each ray."""
        if not self._caster:
            self._caster.append(_scene_of(self.boxes))
        both = np.hstack([np.broadcast_to(eye, rays.shape), rays]).astype(np.float32)
        met: Floats = (
            self._caster[0].cast_rays(o3d.core.Tensor.from_numpy(both))["t_hit"].numpy().astype(np.float64)
        )
        return met


def _box(low: list[float], high: list[float]) -> NDArray[np.float64]:
    return np.array([low, high], np.float64)


def _furnished(rng: np.random.Generator, corner: Floats) -> list[NDArray[np.float64]]:
    """Return the panels and things of a cell, none of which stands at its stop."""
    sizes = [np.array([*rng.permutation([rng.uniform(2, 4), 0.15]), _HEIGHT]) for _ in range(_PANELS)]
    sizes += [rng.uniform([0.4, 0.4, 0.3], [1.8, 1.8, 2.4]) for _ in range(_THINGS)]
    boxes = []
    for size in sizes:
        low = corner + np.append(rng.uniform([0, 0], PITCH - size[:2]), 0.0)
        box, stop = np.stack([low, low + size]), corner[:2] + PITCH / 2
        if (box[0, :2] > stop + _CLEAR).any() or (box[1, :2] < stop - _CLEAR).any():
            boxes.append(box)
    return boxes


def _sampled(
    rng: np.random.Generator, box: NDArray[np.float64], window: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return points evenly over the faces of a box, within a window (2, 3)."""
    parts = []
    low, high = np.maximum(box[0], window[0]), np.minimum(box[1], window[1])
    for axis in range(3):
        u, v = (other for other in range(3) if other != axis)
        count = int((high[u] - low[u]) * (high[v] - low[v]) * _DENSITY)
        for side in (0, 1):
            face = rng.uniform(low, high, (count, 3))
            face[:, axis] = box[side, axis]
            parts.append(face)
    return np.concatenate(parts)


def _scene_of(boxes: NDArray[np.float64]) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    for low, high in boxes:
        mesh = o3d.t.geometry.TriangleMesh.create_box(*(high - low).tolist())
        scene.add_triangles(mesh.translate(o3d.core.Tensor.from_numpy(low.astype(np.float32))))
    return scene
