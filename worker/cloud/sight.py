"""Sights: how far each scan of a visit saw in every direction, and so what stands at a place, or does not.

A scan's range image is kept in the map frame, about its sensor's place: of each direction the nearest and the farthest
return. A point at depth d is held against it:

| verdict | the returns in the point's direction |
| --- | --- |
| through | all lie beyond it: the scan saw through the place |
| surely | those of the eight neighbouring directions lie beyond it as well (grazing floors fool a single one) |
| hidden | all lie before it: something stands in the way |
| confirmed | neither: something stands there |
| none | there are none, or the point is beyond the scan's farthest return: the scan did not look there |
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Floats, Matrix4
from worker.threads import query_threads

CELLS = 96  #: along a face of the cube: 1.2 degrees in its middle, 0.6 at its edge
TOLERANCE = (
    0.08,
    0.01,
)  #: metres, and times the depth, that a return may lie off and still be the same surface
BEYOND = 0.3  #: metres behind a place, from which on a return shows that nothing blocked the view for good
FARTHEST_RESIDUAL = 0.6  #: metres; a residual is no larger
_FEWEST_AROUND = 3  # of eight directions with a return, for the one in their middle to be filled in
_SMOOTH = 0.15  # of the nearest of them, that the farthest may lie behind it
_MILLIMETRE = 0.001  # ranges are kept in these, as uint16: up to 65 m
_AT_ONCE = 1_000_000  # points of a scan whose rays are held together
_FARTHEST = np.uint16(np.iinfo(np.uint16).max)  # in these

Counts = NDArray[np.int16]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Verdicts:
    """How many scans of a visit said what of each of N places."""

    through: Counts  #: (N,)
    surely: Counts  #: (N,) of those that saw through
    confirmed: Counts  #: (N,)
    hidden: Counts  #: (N,)
    residual: NDArray[np.float32]  #: (N,) metres to the nearest return of any scan, along its ray, clipped

    @classmethod
    def none(cls, count: int) -> Self:
        """Say nothing of `count` places."""
        through, surely, confirmed, hidden = np.zeros((4, count), np.int16)
        residual = np.full(count, FARTHEST_RESIDUAL, np.float32)
        return cls(through=through, surely=surely, confirmed=confirmed, hidden=hidden, residual=residual)

    @property
    def judged(self) -> NDArray[np.bool_]:
        """(N,) whether any scan could tell that something stands there, or nothing."""
        return (self.through > 0) | (self.confirmed > 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sights:
    """The range images of S scans, map frame; 0 where a scan had no return."""

    origins: Floats  #: (S, 3) metres
    nearest: NDArray[np.uint16]  #: (S, 6 CELLS^2) millimetres
    farthest: NDArray[np.uint16]  #: (S, 6 CELLS^2) millimetres

    @classmethod
    def of(cls, scans: Iterable[tuple[NDArray[Any], Floats]]) -> Self | None:
        """Take each scan's points (N, 3) and the place (3,) that all were seen from, metres, map frame.

        Returns None where there is no scan.
        """
        return cls.joined([cls._of_one(points, origin) for points, origin in scans])

    @classmethod
    def joined(cls, parts: Iterable[Self | None]) -> Self | None:
        """Put the images of several visits together, or None where none has any."""
        there = [part for part in parts if part is not None]
        if not there:
            return None
        return cls(
            origins=np.concatenate([part.origins for part in there]),
            nearest=np.concatenate([part.nearest for part in there]),
            farthest=np.concatenate([part.farthest for part in there]),
        )

    @classmethod
    def _of_one(cls, points: NDArray[Any], origin: Floats) -> Self:
        nearest = np.full(6 * CELLS**2, np.inf, np.float32)
        farthest = np.zeros(6 * CELLS**2, np.float32)
        for start in range(0, len(points), _AT_ONCE):
            rays = (points[start : start + _AT_ONCE] - origin).astype(np.float32)
            cells = _cells_of(rays)
            ranges = np.minimum(np.sqrt(np.einsum("ij,ij->i", rays, rays)) / _MILLIMETRE, float(_FARTHEST))
            np.minimum.at(nearest, cells, ranges)
            np.maximum.at(farthest, cells, ranges)
        nearest[farthest == 0] = 0
        return cls(
            origins=np.asarray(origin, np.float64)[None],
            nearest=np.rint(nearest).astype(np.uint16)[None],
            farthest=np.rint(farthest).astype(np.uint16)[None],
        )

    def __len__(self) -> int:
        return len(self.origins)

    def subset(self, chosen: NDArray[np.intp]) -> Sights:
        """Return the images of these scans (s,) alone."""
        return Sights(
            origins=self.origins[chosen], nearest=self.nearest[chosen], farthest=self.farthest[chosen]
        )

    def placed(self, target_from_source: Matrix4) -> Sights:
        """Return the images in another frame; each cell keeps the ranges seen through the middle of it."""
        rays = (_middles() @ target_from_source[:3, :3]).astype(
            np.float32
        )  # of each new cell, in the old frame
        cells = _cells_of(rays)
        return Sights(
            origins=self.origins @ target_from_source[:3, :3].T + target_from_source[:3, 3],
            nearest=self.nearest[:, cells],
            farthest=self.farthest[:, cells],
        )

    def blinded(self, low: Floats, high: Floats) -> Sights:
        """Return the images without the rays that meet a box: lowest and highest corners (B, 3), metres, map frame.

        So that scans say no more of places that are known not to be as they were. What those rays saw elsewhere is
        forgotten as well.
        """
        nearest, farthest = self.nearest.copy(), self.farthest.copy()
        for scan, origin in enumerate(self.origins):
            reach = self.farthest[scan].astype(np.float64) * _MILLIMETRE
            gone = _met(origin, reach, low - TOLERANCE[0], high + TOLERANCE[0])
            nearest[scan, gone] = farthest[scan, gone] = 0
        return Sights(origins=self.origins, nearest=nearest, farthest=farthest)

    def verdicts(self, points: NDArray[Any]) -> Verdicts:
        """Hold points (N, 3), metres, map frame, against every scan; each costs only the points within its reach.

        Points in the order of their x, as voxels are, are the cheapest.
        """
        answer = Verdicts.none(len(points))
        order = np.argsort(points[:, 0], kind="stable")
        ordered = np.ascontiguousarray(points[order], np.float32)
        _ = self._images  # made once, before several threads ask for it
        with ThreadPoolExecutor(max(1, query_threads())) as pool:
            for rows, told in pool.map(functools.partial(self._verdicts_of_one, ordered), range(len(self))):
                there = order[rows]
                answer.through[there] += told.through
                answer.surely[there] += told.surely
                answer.confirmed[there] += told.confirmed
                answer.hidden[there] += told.hidden
                answer.residual[there] = np.minimum(answer.residual[there], told.residual)
        return answer

    def stands(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Tell (N,) at which places, metres, map frame, a scan had a return and none from well beyond it.

        What stands there as long as a scan lasts blocks its view. Past somebody who walked by, the scan saw what is
        behind as well, in every direction in which it saw him; past a thing that stands it does so along its edges.
        """
        answer = np.zeros(len(points), bool)
        for origin, nearest, farthest in zip(self.origins, self.nearest, self.farthest, strict=True):
            rays = (points - origin).astype(np.float32)
            cells = _cells_of(rays)
            depth = np.sqrt(np.einsum("ij,ij->i", rays, rays))
            tolerance = TOLERANCE[0] + TOLERANCE[1] * depth
            near, far = (image[cells] * np.float32(_MILLIMETRE) for image in (nearest, farthest))
            answer |= (far >= depth - tolerance) & (far <= depth + BEYOND) & (near <= depth + tolerance)
        return answer

    def _verdicts_of_one(self, ordered: NDArray[np.float32], scan: int) -> tuple[NDArray[np.int64], Verdicts]:
        """Return the rows of the points that one scan reached, and what it says of them."""
        origin, reach = self.origins[scan].astype(np.float32), self.farthest[scan].max() * _MILLIMETRE
        first, last = np.searchsorted(ordered[:, 0], [origin[0] - reach, origin[0] + reach])
        rays = ordered[first:last] - origin
        rows = np.flatnonzero(np.abs(rays[:, 1]) <= reach)
        if len(rows) < len(rays):
            rays = rays[rows]
        cells = _cells_of(rays)
        depth = np.sqrt(np.einsum("ij,ij->i", rays, rays))
        nearest, farthest, around = (image[scan][cells] * np.float32(_MILLIMETRE) for image in self._images)
        tolerance = TOLERANCE[0] + TOLERANCE[1] * depth
        known = farthest > 0
        through = known & (nearest > depth + tolerance)
        hidden = known & (farthest < depth - tolerance)
        gap = np.where(known, np.maximum(np.maximum(nearest - depth, depth - farthest), 0), FARTHEST_RESIDUAL)
        return first + rows, Verdicts(
            through=through.astype(np.int16),
            surely=(through & (around > depth + tolerance)).astype(np.int16),
            confirmed=(known & ~through & ~hidden).astype(np.int16),
            hidden=hidden.astype(np.int16),
            residual=np.minimum(gap, FARTHEST_RESIDUAL).astype(np.float32),
        )

    @functools.cached_property
    def _images(self) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint16]]:
        """(S, 6 CELLS^2) millimetres each: nearest, farthest, and the nearest with the eight directions around.

        Scan lines lie apart: a direction without a return takes the nearest and the farthest of those around it where
        at least three have one, and all of about the same range.
        """
        neighbours = _neighbours()
        unknown = self.nearest == 0
        least, most = np.where(unknown, _FARTHEST, self.nearest), self.farthest
        around, beyond = least.copy(), np.zeros_like(most)
        count = np.zeros(least.shape, np.int8)
        for neighbour in neighbours:
            np.minimum(around, least[:, neighbour], out=around)
            np.maximum(beyond, most[:, neighbour], out=beyond)
            count += most[:, neighbour] > 0
        smooth = beyond <= around * (1 + _SMOOTH)
        filled = unknown & (count >= _FEWEST_AROUND) & smooth
        nearest = np.where(filled, around, self.nearest)
        return nearest, np.where(filled, beyond, self.farthest), around


def _cells_of(rays: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return (N,) the cell of a cube around the origin that each ray (N, 3) goes through, of any length."""
    x, y, z = rays.T
    ax, ay, az = np.abs(x), np.abs(y), np.abs(z)
    along_x = (ax >= ay) & (ax >= az)
    along_y = ~along_x & (ay >= az)
    along = np.where(along_x, x, np.where(along_y, y, z))
    first, second = np.where(along_x, y, x), np.where(along_x | along_y, z, y)
    face = 2 * np.where(along_x, 0, np.where(along_y, 1, 2)).astype(np.int32) + (along > 0)
    half = np.float32(CELLS / 2) / np.maximum(np.abs(along), np.float32(1e-9))
    u = np.minimum((first * half + np.float32(CELLS / 2)).astype(np.int32), CELLS - 1)
    v = np.minimum((second * half + np.float32(CELLS / 2)).astype(np.int32), CELLS - 1)
    cells: NDArray[np.int32] = (face * CELLS + u) * CELLS + v
    return cells


def _met(origin: Floats, reach: Floats, low: Floats, high: Floats) -> NDArray[np.bool_]:
    """Tell (6 CELLS^2,) in which directions a ray of `reach` (6 CELLS^2,) metres meets a box (slab method)."""
    met = np.zeros(len(reach), bool)
    rays = _middles()
    for corners in zip(low - origin, high - origin, strict=True):
        sides = np.stack(corners)[:, None] / rays
        first, last = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        met |= (first <= last) & (last >= 0) & (first <= reach)
    return met


@functools.cache
def _middles() -> NDArray[np.float64]:
    """Return (6 CELLS^2, 3) the unit vector through the middle of each cell; none lies along an axis."""
    faces, u, v = np.unravel_index(np.arange(6 * CELLS**2), (6, CELLS, CELLS))
    axis, rows = faces // 2, np.arange(6 * CELLS**2)
    rays = np.empty((len(rows), 3))
    rays[rows, axis] = np.where(faces % 2, 1.0, -1.0)
    rays[rows, np.where(axis == 0, 1, 0)] = 2 * (u + 0.5) / CELLS - 1
    rays[rows, np.where(axis == 2, 1, 2)] = 2 * (v + 0.5) / CELLS - 1
    unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


@functools.cache
def _neighbours() -> NDArray[np.int32]:
    """Return (8, 6 CELLS^2) of each cell those around it, across the edges of the cube as well."""
    faces, u, v = np.unravel_index(np.arange(6 * CELLS**2), (6, CELLS, CELLS))
    axis, sign = faces // 2, np.where(faces % 2, 1.0, -1.0)
    rings = []
    for du, dv in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        a, b = (2 * (u + 0.5 + du) / CELLS - 1, 2 * (v + 0.5 + dv) / CELLS - 1)
        rays = np.empty((len(faces), 3), np.float32)
        rows = np.arange(len(faces))
        rays[rows, axis] = sign
        rays[rows, np.where(axis == 0, 1, 0)] = a
        rays[rows, np.where(axis == 2, 1, 2)] = b
        rings.append(_cells_of(rays))
    return np.stack(rings)
