"""Contradictions: what rays of a scan and of a map's scans say against a pose, in the building and in its things.

A pose lays two visits over each other. Then points of each stand where the other looked: it saw a return there as well,
or looked through the place. Both are counted, in both directions, apart for the building itself (walls, floor, ceiling)
and for the things in it: a room that was rearranged contradicts in its things alone, another room in its walls too.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from worker.cloud.poses import inverse, transformed
from worker.cloud.sight import Sights
from worker.cloud.types import Bools, Floats, Matrix4
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.surface import Surface, facing

SURFACE_DISTANCE = 0.05  #: metres off a tangent plane, up to which a point lies on a surface
REACH = 0.3  #: metres; farther from the other cloud than this, a point is not compared by surfaces
#: metres along a surface from its nearest point, beyond which nothing is known of it: clouds are sparse at their edges
BESIDE = 0.12
OWN = 1.0  #: metres around the sensor that are not asked: what stands there is the robot
_SAMPLE = 3_000  # points asked in each direction, of the building and of its things each
_CELL = 0.06  # metres, of the columns that hold a wall
_UPPER = 0.75  # of the height from floor to ceiling, above which hardly a thing reaches
_STEEP, _LEVEL = 0.35, 0.7  # vertical part of a wall's normal at most, of a floor's at least
_SLAB = 0.15  # metres of floor and ceiling
_APART = 0.25  # metres between two things, at least
_FEWEST = 12  # points of a thing
_AGREES, _CONTRADICTED = 0.3, 0.6  # share of a thing's points that are not confirmed: at most, and at least

#: Rows and columns of the counts.
INTO_MAP, INTO_SCAN = 0, 1  #: the scan's points held against the map, and the map's against the scan
BUILDING, THINGS = 0, 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """A map as poses are judged by it."""

    surface: Surface
    sights: Sights | None  #: what its scans saw; None: nobody knows from where they did

    @functools.cached_property
    def building(self) -> Bools:
        """(M,) which points belong to walls, floor and ceiling."""
        return building_of(self.surface.points, self.surface.normals)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Contradictions:
    """Counts under one pose: [direction, kind], see `INTO_MAP` and `BUILDING`."""

    judged: Floats  #: (2, 2) points of which the other visit can say that something stands there, or nothing
    through: Floats  #: (2, 2) of those, that it looked through
    near: Floats  #: (2, 2) points within reach of the other's surfaces, seen from the same side
    off: Floats  #: (2, 2) of those, that do not lie on them
    things: (
        Floats  #: (2, 2) [direction, ...] how many things agree with the other visit, how many it contradicts
    )

    def __add__(self, other: Contradictions) -> Contradictions:
        return Contradictions(
            judged=self.judged + other.judged,
            through=self.through + other.through,
            near=self.near + other.near,
            off=self.off + other.off,
            things=self.things + other.things,
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Held:
    """Points of one cloud held against the other."""

    points: Floats  #: (N, 3) metres, map frame
    building: Bools  #: (N,) part of walls, floor or ceiling
    judged: Bools  #: (N,) the other looked there
    through: Bools  #: (N,) and through it
    near: Bools  #: (N,) within reach of the other's surfaces
    off: Bools  #: (N,) and not on them

    def counts(self) -> NDArray[np.float64]:
        """Return (5, 2): judged, through, near and off, of the building and of things; things agreeing and not."""
        rows = [self.judged, self.through, self.near, self.off]
        kinds = [[np.sum(row & self.building), np.sum(row & ~self.building)] for row in rows]
        return np.array([*kinds, self._things()], float)

    def _things(self) -> tuple[int, int]:
        """Count the things, connected points of no wall, that the other visit confirms, and those that it does not."""
        asked = ~self.building & (self.judged | self.near)
        if not asked.any():
            return 0, 0
        cells = np.floor(self.points[asked] / _APART).astype(np.int64)
        cells -= cells.min(axis=0)
        there = np.zeros(cells.max(axis=0) + 1, bool)
        there[tuple(cells.T)] = True
        labels, count = label(there, np.ones((3, 3, 3)))
        thing = labels[tuple(cells.T)]
        size = np.bincount(thing, minlength=count + 1)
        denied = np.bincount(thing, (self.through | self.off)[asked], count + 1)
        share = denied[size >= _FEWEST] / size[size >= _FEWEST]
        return int(np.sum(share <= _AGREES)), int(np.sum(share >= _CONTRADICTED))


def contradictions(
    scan: PreparedScan, place: Place, map_from_scan: Matrix4, *, sample: int = _SAMPLE
) -> Contradictions:
    """Count what both visits say of each other's points under a pose; the scan's frame may have any origin."""
    return counted(held_both_ways(scan, place, map_from_scan, sample=sample))


def counted(held: tuple[Held, Held]) -> Contradictions:
    """Count what `held_both_ways` found."""
    judged, through, near, off, things = np.stack([one.counts() for one in held], axis=1)
    return Contradictions(judged=judged, through=through, near=near, off=off, things=things)


def held_both_ways(
    scan: PreparedScan, place: Place, map_from_scan: Matrix4, *, sample: int = _SAMPLE
) -> tuple[Held, Held]:
    """Hold the scan's points against the map, and the map's against the scan."""
    return _into_map(scan, place, map_from_scan, sample), _into_scan(scan, place, map_from_scan, sample)


def _into_map(scan: PreparedScan, place: Place, map_from_scan: Matrix4, sample: int) -> Held:
    points = transformed(scan.surface.points, map_from_scan)
    normals = scan.surface.normals @ map_from_scan[:3, :3].T
    building = building_of(points, normals)
    rows = _sampled(_far_from_sensor(scan, scan.surface.points), building, sample)
    near, off = _by_surface(scan.surface, place.surface, map_from_scan, rows)
    judged, through = _by_rays(place.sights, points[rows])
    return Held(
        points=points[rows], building=building[rows], judged=judged, through=through, near=near, off=off
    )


def _into_scan(scan: PreparedScan, place: Place, map_from_scan: Matrix4, sample: int) -> Held:
    scan_from_map = inverse(map_from_scan)
    there = transformed(place.surface.points, scan_from_map)
    low, high = scan.surface.points.min(axis=0) - REACH, scan.surface.points.max(axis=0) + REACH
    around = np.all((there > low) & (there < high), axis=1) & _far_from_sensor(scan, there)
    rows = _sampled(around, place.building, sample)
    near, off = _by_surface(place.surface, scan.surface, scan_from_map, rows)
    judged, through = _by_rays(scan.sights, there[rows])
    return Held(
        points=place.surface.points[rows],
        building=place.building[rows],
        judged=judged,
        through=through,
        near=near,
        off=off,
    )


def building_of(points: Floats, normals: Floats) -> Bools:
    """Tell (N,) which points, metres, z up, belong to walls, floor and ceiling: (N, 3) each.

    A wall is a column of upright surface that reaches the upper quarter of the height: hardly a thing does. What else
    is up there, lamps and pipes, comes with the building as well.
    """
    floor, ceiling = np.percentile(points[:, 2], (1, 99)) if len(points) else (0.0, 0.0)
    height, z = points[:, 2] - floor, np.abs(normals[:, 2])
    level = (z > _LEVEL) & (height < _SLAB)
    high, upright = height > _UPPER * (ceiling - floor), z < _STEEP
    columns = np.floor(points[:, :2] / _CELL).astype(np.int64)
    columns -= columns.min(axis=0, initial=0) - 1
    wall = np.zeros(columns.max(axis=0, initial=0) + 2, bool)
    upper = columns[upright & high & (points[:, 2] < ceiling - _SLAB)]
    for east in (-1, 0, 1):
        for north in (-1, 0, 1):
            wall[upper[:, 0] + east, upper[:, 1] + north] = True
    building: Bools = level | high | (upright & wall[columns[:, 0], columns[:, 1]])
    return building


def _by_rays(sights: Sights | None, points: Floats) -> tuple[Bools, Bools]:
    """Return (N,) whether a scan looked there, and whether all that did saw through it, one of them surely."""
    if sights is None:
        nowhere = np.zeros(len(points), bool)
        return nowhere, nowhere
    told = sights.verdicts(points)
    confirmed, surely = told.confirmed > 0, told.surely > 0
    return confirmed | surely, surely & ~confirmed


def _by_surface(
    cloud: Surface, surface: Surface, surface_from_cloud: Matrix4, rows: NDArray[np.intp]
) -> tuple[Bools, Bools]:
    """Return (N,) which of these points of the cloud are near the surface, from the same side, and which off it."""
    part = cloud.selected(rows)
    points = transformed(part.points, surface_from_cloud)
    distance, index = surface.nearest(points, within=REACH)
    near = facing(part, surface, surface_from_cloud, index, np.isfinite(distance))
    gap = points[near] - surface.points[index[near]]
    off_plane = np.abs(np.einsum("ij,ij->i", gap, surface.normals[index[near]]))
    beside = np.sqrt(np.maximum(distance[near] ** 2 - off_plane**2, 0.0)) > BESIDE
    off = np.zeros(len(points), bool)
    off[near] = (off_plane > SURFACE_DISTANCE) & ~beside
    near[near] = ~beside
    return near, off


def _far_from_sensor(scan: PreparedScan, points: Floats) -> Bools:
    if scan.origin is None:
        return np.ones(len(points), bool)
    far: Bools = np.linalg.norm(points - scan.origin, axis=1) > OWN
    return far


def _sampled(which: Bools, building: Bools, count: int) -> NDArray[np.intp]:
    """Return rows, ascending, at most `count` of the building and as many of the things in it."""
    kinds = (np.flatnonzero(which & kind) for kind in (building, ~building))
    return np.sort(np.concatenate([rows[:: max(1, -(-len(rows) // count))] for rows in kinds]))
