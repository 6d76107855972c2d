"""Edits: real visits with solids and real things put into one of the two, and the truth about the voxels of each.

A return whose ray meets a solid moves onto it (`worker.training.voxels.insertion`), so noise, density, gaps and poses
stay those of the real scans. Where nobody knows a sensor's place, points are added and nothing has a shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.benchmarks.real.visits import RealScan, TwoVisits
from worker.cloud.carrier import CarrierSettings, floor_height
from worker.cloud.seen import Seen
from worker.cloud.types import Floats, Points
from worker.cloud.voxel_keys import Keys, centers, near, packed, regions, rows_of
from worker.cloud.voxels import Voxels
from worker.simulation.hits import FEWEST_RAYS, rays_past
from worker.training.voxels.insertion import InsertedScan, inserted, random_solids
from worker.training.voxels.solids import Box, CloudObject, Cylinder, Solid, spheres_meet

VOXEL = 0.05  #: metres, of the truth
Side = Literal["first", "second"]
SIDES: tuple[Side, Side] = ("first", "second")

_SIZE = (0.2, 1.0)  # metres, extents of boxes and cylinders
_BLIND_SIZE = (0.2, 0.6)  # metres, likewise where rays are unknown: what lies farther in, nobody knows
_SOLIDS = 5  # that are put into a visit
_KNOWN = 0.3  # metres from what a blind visit hit, within which it is said to know what stands there
_TRIES = 200
_NOISE = 0.01  # metres
_VIEWS = 8  # places around a solid from which its surface is sampled, where there are no rays
_THING_POINTS, _THING_SIZE, _THINNEST = 150, (0.4, 1.2), 0.2  # points; metres, longest and least extent
_OFF_FLOOR, _UP_TO, _UNDER_CEILING = 0.08, 1.0, (1.8, 0.15)  # metres between which things are looked for


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TrueRegion:
    """A thing that stands in one of the visits alone."""

    kind: str  #: box, cylinder, furniture or real thing
    side: Side  #: in which it stands
    decidable: (
        Keys  #: (n,) ascending: voxels that it was hit in, and that the other visit's rays went through
    )
    hit: Keys  #: (m,) ascending: all that it was hit in, or lies within a voxel of


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class EditedVisits:
    """Two real visits with things in one of them."""

    base: str  #: name of the visits as they are
    visits: TwoVisits
    regions: tuple[TrueRegion, ...]


def edited(visits: TwoVisits, side: Side, things: Sequence[CloudObject], *, seed: int) -> EditedVisits:
    """Put things into one of the visits. What is put into the first has disappeared, into the second appeared."""
    rng = np.random.default_rng(seed)
    solids = _drawn(visits, things, rng)
    own, other = (visits.first, visits.second) if side == "first" else (visits.second, visits.first)
    if visits.blind:
        changed = [_added(scan, solids if row == 0 else [], rng) for row, scan in enumerate(own)]
    else:
        changed = [InsertedScan.of(scan, solids, rng) for scan in own]
    scans = tuple(replace(scan, points=new.points) for scan, new in zip(own, changed, strict=True))
    name = f"{visits.name}, {'gone' if side == 'first' else 'new'} things, seed {seed}"
    new = replace(visits, first=scans) if side == "first" else replace(visits, second=scans)
    return EditedVisits(
        base=visits.name,
        visits=replace(new, name=name),
        regions=tuple(
            _region(number, solid, side, changed, other, blind=visits.blind)
            for number, solid in enumerate(solids)
        ),
    )


def real_things(scan: RealScan) -> list[CloudObject]:
    """Cut things of 40 to 120 cm out of a scan that stands upright: connected points off the floor, or off the ceiling.

    They are chairs and boxes in one data set and lamps in another; walls and large furniture are too large.
    """
    points, floor = scan.points, None
    if scan.sensor_origin is not None:
        below = floor_height(points - scan.sensor_origin, CarrierSettings.model_validate({}))
        floor = None if below is None else float(scan.sensor_origin[2]) + below
    top = float(np.percentile(points[:, 2], 99))
    low, high = (
        (top - _UNDER_CEILING[0], top - _UNDER_CEILING[1])
        if floor is None
        else (floor + _OFF_FLOOR, floor + _UP_TO)
    )
    chosen = points[(points[:, 2] > low) & (points[:, 2] < high)]
    keys = Voxels.keys_of(chosen, size=VOXEL)
    occupied = np.unique(keys)
    count, labels = regions(occupied)
    label = labels[rows_of(keys, occupied)]
    parts = [
        chosen[label == number]
        for number in np.flatnonzero(np.bincount(label, minlength=count) >= _THING_POINTS)
    ]
    return [CloudObject.of(part, spacing=VOXEL) for part in parts if _is_thing(part)]


def _is_thing(points: Points) -> bool:
    extents = np.sort(np.ptp(points, axis=0))
    return bool(_THING_SIZE[0] <= extents[2] <= _THING_SIZE[1] and extents[0] >= _THINNEST)


def _drawn(visits: TwoVisits, things: Sequence[CloudObject], rng: np.random.Generator) -> list[Solid]:
    scans = [*visits.first, *visits.second]
    if visits.blind:
        return _beside(np.concatenate([scan.points for scan in scans]), things, rng)
    return random_solids(scans, rng, _SOLIDS, _SIZE, things=things)


def _beside(points: Points, things: Sequence[CloudObject], rng: np.random.Generator) -> list[Solid]:
    """Draw solids in empty places close to what was hit, where rays are unknown."""
    solids: list[Solid] = []
    inwards = points.mean(axis=0)
    for _ in range(_SOLIDS):
        for _ in range(_TRIES):
            half = np.exp(rng.uniform(np.log(_BLIND_SIZE[0]), np.log(_BLIND_SIZE[1]), 3)) / 2
            thing = things[int(rng.integers(len(things)))] if things and rng.random() < 2 / 3 else None
            half = half if thing is None else thing.half
            spot = points[int(rng.integers(len(points)))].astype(np.float64)
            away = (inwards - spot) / max(float(np.linalg.norm(inwards - spot)), 1e-9)
            middle = spot + away * (np.linalg.norm(half) + 0.08)
            yaw = float(rng.uniform(0, 2 * np.pi))
            solid: Solid = (
                Box(middle=middle, half=half, yaw=yaw) if thing is None else thing.moved(middle, yaw)
            )
            if not spheres_meet(solid, solids) and not solid.holds(points, VOXEL).any():
                solids.append(solid)
                break
    return solids


def _added(scan: RealScan, solids: Sequence[Solid], rng: np.random.Generator) -> InsertedScan:
    """Add points on the surfaces of solids, as dense as the scan's own."""
    sample = scan.points[:: max(1, len(scan.points) // 2000)]
    spacing = float(np.median(cKDTree(scan.points).query(sample, k=2)[0][:, 1]))
    surfaces = [surface(solid, max(spacing, 0.01), rng) for solid in solids]
    owner = [np.full(len(points), number, np.int32) for number, points in enumerate(surfaces)]
    return InsertedScan(
        points=np.concatenate([scan.points, *surfaces]).astype(np.float32),
        sensor_origin=scan.sensor_origin,
        owner=np.concatenate([np.full(len(scan.points), -1, np.int32), *owner]),
    )


def surface(solid: Solid, spacing: float, rng: np.random.Generator) -> Floats:
    """Return points (n, 3) on a solid, about `spacing` metres apart, as seen from all around and a little above."""
    distance = 2 * solid.radius + 1.0
    seen = []
    for turn in np.arange(_VIEWS) * 2 * np.pi / _VIEWS:
        view = solid.middle + distance * np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.4, 0.8)])
        steps = np.arange(-solid.radius, solid.radius, spacing)
        side = np.array([-np.sin(turn), np.cos(turn), 0.0])
        wide, high = (axis.ravel() for axis in np.meshgrid(steps, steps))
        targets = solid.middle + wide[:, None] * side + high[:, None] * np.array([0.0, 0.0, 1.0])
        beyond = view + 3 * (targets - view)
        points, owner = inserted(beyond, view, [solid], rng, range_sigma=_NOISE)
        seen.append(points[owner == 0])
    points = np.concatenate(seen).astype(np.float64)
    _, kept = np.unique(packed(np.floor(points / spacing).astype(np.int64)), return_index=True)
    return np.asarray(points[kept])


def _region(
    number: int,
    solid: Solid,
    side: Side,
    changed: Sequence[InsertedScan],
    other: Sequence[RealScan],
    *,
    blind: bool,
) -> TrueRegion:
    """Tell in which voxels a solid was hit, and which of them the other visit can decide."""
    own = Seen.of(changed, voxel_size=VOXEL)
    on_solid = np.zeros(len(own.keys))
    for scan in changed:
        rows = rows_of(Voxels.keys_of(scan.points, size=VOXEL), own.keys)
        on_solid += np.bincount(rows, weights=scan.owner == number, minlength=len(own.keys))
    others = Seen.of(other, voxel_size=VOXEL).keys
    mostly = own.keys[2 * on_solid >= np.maximum(own.hits, 1)]
    lonely = mostly[~near(mostly, others, 1)]
    places = centers(lonely, VOXEL)
    return TrueRegion(
        kind=_kind(solid),
        side=side,
        decidable=lonely[_known(places, other) if blind else _looked_through(places, other)],
        hit=own.keys[on_solid > 0],
    )


def _looked_through(places: Floats, scans: Sequence[RealScan]) -> NDArray[np.bool_]:
    count = np.zeros(len(places), np.int64)
    for scan in scans:
        if scan.sensor_origin is not None and len(places):
            count += rays_past(places, scan.sensor_origin, scan.points)
    return np.asarray(count >= FEWEST_RAYS)


def _known(places: Floats, scans: Sequence[RealScan]) -> NDArray[np.bool_]:
    tree = cKDTree(np.concatenate([scan.points for scan in scans]))
    if not len(places):
        return np.zeros(0, bool)
    return np.asarray(tree.query(places)[0] < _KNOWN)


def _kind(solid: Solid) -> str:
    if isinstance(solid, CloudObject):
        return "real thing"
    return "box" if isinstance(solid, Box) else "cylinder" if isinstance(solid, Cylinder) else "furniture"
