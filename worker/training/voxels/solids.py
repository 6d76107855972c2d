"""Solids: things that rays meet. Upright boxes and cylinders, unions of them, and things cut out of another scan.

A solid says how far along each ray its surface lies. All stand upright in the map frame, z up, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from worker.cloud.types import Bools, Floats

_CELL = np.tan(np.radians(0.4))  # of the depth image that an object is rendered by
_WIDEST = 2.5  # tangent of the angle off the middle, beyond which an object is cut off
_LEAP = 0.05  # metres; a return so much behind its neighbours was seen through a hole between points
_LARGEST_HOLE = 10  # cells, half width, that is closed
_LATTICE = 5  # places along each axis of a part


class Solid(Protocol):
    """Something that rays meet."""

    @property
    def middle(self) -> Floats:
        """(3,) metres, map frame: of a sphere around it."""

    @property
    def radius(self) -> float:
        """Metres, of that sphere."""

    def ranges(self, origin: Floats, rays: Floats) -> Floats:
        """Return (N,) metres to where unit rays (N, 3) from `origin` (3,) meet it first, inf where they do not."""

    def holds(self, points: NDArray[Any], margin: float = 0.0) -> Bools:
        """Tell (N,) which points (N, 3) lie in it, or no more than `margin` metres off."""

    def places(self) -> Floats:
        """Return some places (K, 3) within it, by which it can be asked whether its room is free."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Box:
    """An upright box."""

    middle: Floats  #: (3,) metres, map frame
    half: Floats  #: (3,) metres, half its extents along its own axes
    yaw: float = 0.0  #: radians, counter-clockwise about z

    @property
    def radius(self) -> float:
        return float(np.linalg.norm(self.half))

    def ranges(self, origin: Floats, rays: Floats) -> Floats:
        """Cut the rays with three slabs (Kay and Kajiya 1986)."""
        start, ahead = _turned(origin - self.middle, -self.yaw), _turned(rays, -self.yaw)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (-self.half - start) / ahead, (self.half - start) / ahead
        entry, leave = np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)
        return _met(entry, leave)

    def holds(self, points: NDArray[Any], margin: float = 0.0) -> Bools:
        off = _turned(points - self.middle, -self.yaw)
        return np.asarray((np.abs(off) <= self.half + margin).all(axis=1))

    def places(self) -> Floats:
        return self.middle + _turned(_lattice() * self.half, self.yaw)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Cylinder:
    """An upright cylinder."""

    middle: Floats  #: (3,) metres, map frame
    girth: float  #: metres from its axis to its mantle
    half_height: float  #: metres

    @property
    def radius(self) -> float:
        return float(np.hypot(self.girth, self.half_height))

    def ranges(self, origin: Floats, rays: Floats) -> Floats:
        """Cut the rays with the endless cylinder and with the slab between its ends."""
        start = origin - self.middle
        a = rays[:, 0] ** 2 + rays[:, 1] ** 2
        b = rays[:, :2] @ start[:2]
        c = float(start[:2] @ start[:2]) - self.girth**2
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = (-b - root) / a, (-b + root) / a
            ends = (-self.half_height - start[2]) / rays[:, 2], (self.half_height - start[2]) / rays[:, 2]
        upright = a < 1e-12
        entry = np.where(upright, -np.inf if c <= 0 else np.inf, sides[0])
        leave = np.where(upright, np.inf, sides[1])
        entry, leave = np.fmax(entry, np.fmin(*ends)), np.fmin(leave, np.fmax(*ends))
        missed = (b**2 < a * c) & ~upright
        return np.where(missed, np.inf, _met(entry, leave))

    def holds(self, points: NDArray[Any], margin: float = 0.0) -> Bools:
        off = points - self.middle
        flat = np.hypot(off[:, 0], off[:, 1]) <= self.girth + margin
        inside: Bools = flat & (np.abs(off[:, 2]) <= self.half_height + margin)
        return inside

    def places(self) -> Floats:
        lattice = _lattice()
        round_ones = lattice[np.hypot(lattice[:, 0], lattice[:, 1]) <= 1]
        return self.middle + round_ones * [self.girth, self.girth, self.half_height]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Union:
    """Several solids that stand as one."""

    parts: tuple[Solid, ...]  #: at least one

    @property
    def middle(self) -> Floats:
        return np.asarray(np.mean([part.middle for part in self.parts], axis=0))

    @property
    def radius(self) -> float:
        middle = self.middle
        return float(max(np.linalg.norm(part.middle - middle) + part.radius for part in self.parts))

    def ranges(self, origin: Floats, rays: Floats) -> Floats:
        return np.asarray(np.min([part.ranges(origin, rays) for part in self.parts], axis=0))

    def holds(self, points: NDArray[Any], margin: float = 0.0) -> Bools:
        return np.asarray(np.any([part.holds(points, margin) for part in self.parts], axis=0))

    def places(self) -> Floats:
        return np.concatenate([part.places() for part in self.parts])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CloudObject:
    """A real thing, as the points that a scanner gave of it; what no scanner saw of it is not there."""

    points: Floats  #: (N, 3) metres, map frame; at least two
    middle: Floats  #: (3,) metres: the middle of the box around them
    spacing: float  #: metres between points of one surface, or less

    @classmethod
    def of(cls, points: NDArray[Any], *, spacing: float | None = None) -> Self:
        """Take the points (N, 3) of a thing, metres. Raises ValueError for fewer than two.

        Say the spacing of a scanner whose lines lie farther apart than the points of a line, or one sees through
        between them.
        """
        if len(points) < 2:
            raise ValueError(f"an object of {len(points)} points has no surface; give at least two")
        exact = np.asarray(points, np.float64)
        if spacing is None:
            nearest, _ = cKDTree(exact).query(exact, k=2)
            spacing = float(np.percentile(nearest[:, 1], 90))
        return cls(points=exact, middle=(exact.min(axis=0) + exact.max(axis=0)) / 2, spacing=spacing)

    @property
    def radius(self) -> float:
        return float(np.linalg.norm(self.points - self.middle, axis=1).max())

    @property
    def half(self) -> Floats:
        """(3,) metres: half of the box around it, along the axes of the map."""
        return np.asarray((self.points.max(axis=0) - self.points.min(axis=0)) / 2)

    def moved(self, middle: Floats, yaw: float) -> Self:
        """Return the same turned by `yaw` (radians) about its own upright axis, its box's middle at `middle` (3,)."""
        turned = _turned(self.points - self.middle, yaw)
        shift = middle - (turned.min(axis=0) + turned.max(axis=0)) / 2
        return type(self)(points=turned + shift, middle=np.asarray(middle, float), spacing=self.spacing)

    def ranges(self, origin: Floats, rays: Floats) -> Floats:
        """Render its points into a depth image of 0.4 degrees about its middle, and look each ray up there.

        Holes that its spacing explains are closed by a morphological opening of the depths.
        """
        axes = _looking_at(self.middle - origin)
        across, along, depths = _projected(self.points - origin, axes)
        shown = (along > 0) & (np.abs(across) < _WIDEST).all(axis=1)
        distance = float(np.linalg.norm(self.middle - origin))
        hole = int(np.clip(np.ceil(self.spacing / (distance * _CELL)), 1, _LARGEST_HOLE))
        result = np.full(len(rays), np.inf)
        if not shown.any():
            return result
        low = np.floor(across[shown].min(axis=0) / _CELL).astype(np.int64) - 2 * hole
        cells = np.floor(across[shown] / _CELL).astype(np.int64) - low
        image = np.full(cells.max(axis=0) + 2 * hole + 1, np.inf)
        np.minimum.at(image, tuple(cells.T), depths[shown])
        image = _without_holes(image, hole)
        across, along, _ = _projected(rays, axes)
        there = np.flatnonzero((along > 0) & (np.abs(across) < _WIDEST).all(axis=1))
        cells = np.floor(across[there] / _CELL).astype(np.int64) - low
        inside = ((cells >= 0) & (cells < image.shape)).all(axis=1)
        result[there[inside]] = image[tuple(cells[inside].T)]
        return result

    def holds(self, points: NDArray[Any], margin: float = 0.0) -> Bools:
        """Take the box around it for the thing itself: what stands within a chair's legs is in its way."""
        return np.asarray((np.abs(points - self.middle) <= self.half + margin).all(axis=1))

    def places(self) -> Floats:
        return self.points[:: max(1, len(self.points) // _LATTICE**3)]


def table(middle: Floats, size: Floats, yaw: float, *, plate: float = 0.04, leg: float = 0.05) -> Union:
    """Return a plate on four legs: `size` (3,) metres along its own axes, `middle` (3,) of the box around it."""
    half = np.asarray(size, float) / 2
    above = np.array([0.0, 0.0, half[2] - plate / 2])
    top = Box(middle=middle + above, half=np.array([half[0], half[1], plate / 2]), yaw=yaw)
    return Union(parts=(top, *_legs(middle, half, half[2] - plate / 2, yaw, leg)))


def chair(middle: Floats, size: Floats, yaw: float, *, plate: float = 0.05, leg: float = 0.04) -> Union:
    """Return a seat at half its height on four legs, with a back: `size` (3,) metres, `middle` (3,) as for a table."""
    half = np.asarray(size, float) / 2
    seat = Box(middle=middle, half=np.array([half[0], half[1], plate / 2]), yaw=yaw)
    behind = _turned(np.array([-half[0] + plate / 2, 0.0, half[2] / 2]), yaw)
    back = Box(middle=middle + behind, half=np.array([plate / 2, half[1], half[2] / 2]), yaw=yaw)
    return Union(parts=(seat, back, *_legs(middle, half, 0.0, yaw, leg)))


def _legs(middle: Floats, half: Floats, top: float, yaw: float, thick: float) -> list[Box]:
    """Return four legs from the bottom up to `top` metres above the middle."""
    height = (top + half[2]) / 2
    legs = []
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        corner = np.array([x * (half[0] - thick / 2), y * (half[1] - thick / 2), top - height])
        place = middle + _turned(corner, yaw)
        legs.append(Box(middle=place, half=np.array([thick / 2, thick / 2, height]), yaw=yaw))
    return legs


def _met(entry: Floats, leave: Floats) -> Floats:
    """Return (N,) where rays enter, inf where they pass by, look away or start within."""
    return np.where((entry <= leave) & (entry > 0), entry, np.inf)


def _turned(vectors: NDArray[Any], yaw: float) -> Floats:
    """Turn vectors (..., 3) about z by `yaw` radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    turned: Floats = vectors @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return turned


def _lattice() -> Floats:
    """Return (K, 3) places evenly in a cube from -1 to 1, its faces among them."""
    steps = np.linspace(-1, 1, _LATTICE)
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)


def _looking_at(direction: Floats) -> Floats:
    """Return (3, 3), in rows: a direction of unit length and two others across it."""
    ahead = direction / max(float(np.linalg.norm(direction)), 1e-9)
    helper = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(ahead, helper)
    right /= np.linalg.norm(right)
    return np.stack([ahead, right, np.cross(right, ahead)])


def _projected(vectors: Floats, axes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return tangents across (N, 2), metres along (N,) and lengths (N,) of vectors (N, 3)."""
    seen = vectors @ axes.T
    along = seen[:, 0]
    tangents = seen[:, 1:] / np.maximum(along, 1e-9)[:, None]
    return tangents, along, np.linalg.norm(vectors, axis=1)


def _without_holes(image: Floats, reach: int) -> Floats:
    """Fill what is empty or far behind in an image of depths, where no square of (2 reach + 1) cells fits in."""
    size = 2 * reach + 1
    opened = maximum_filter(minimum_filter(image, size, mode="nearest"), size, mode="nearest")
    filled: Floats = np.where(image > opened + _LEAP, opened, image)
    return filled


def spheres_meet(one: Solid, others: Sequence[Solid]) -> bool:
    """Tell whether the sphere around a solid meets that around any of the others."""
    return any(np.linalg.norm(one.middle - other.middle) < one.radius + other.radius for other in others)
