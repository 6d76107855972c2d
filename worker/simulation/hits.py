"""What truly changed between two visits, by the simulator's own hits: which voxels, of which thing, and who could tell.

A surface that nobody hit is nobody's to find, and one that the other visit did not look through nobody's to judge. So a
changed voxel is one that the visit in which the thing stands has hit, and it is decidable if the other visit's rays
went through it. Noise and losses are the sensor's; poses are the true ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.cloud.poses import inverse, transformed
from worker.cloud.types import Bools, Floats, Matrix4
from worker.cloud.voxel_keys import Keys, centers
from worker.cloud.voxels import Voxels
from worker.simulation.scenes import ChangeKind, Scene
from worker.simulation.scenes.scene import SceneObject
from worker.simulation.sensor import SimulatedScan
from worker.simulation.truth import CELL, FAR, KINDS, same_place, sampled

ON_SURFACE = 0.05  #: metres; a hit farther from every surface of its own visit is a mixed pixel
PASSING = 0.04  #: metres by which a ray may miss a voxel's middle and still tell of it
BEHIND = 0.10  #: metres that it has to go on behind the middle
FEWEST_RAYS = 2  #: that tell of a voxel
#: Metres; nearer to a surface of the other visit a surface is not called changed at all, not even slightly.
SLIGHT = 0.02


class Visit(IntEnum):
    """The visit in which a thing stands."""

    FIRST = 0  #: what stood there then has disappeared
    SECOND = 1  #: what stands there since has appeared


@dataclass(frozen=True, kw_only=True, slots=True)
class EditedThing:
    """A thing that does not stand in both visits at the same place."""

    object_id: int
    kind: int  #: index into KINDS
    size: float  #: metres, longest edge of the box around it


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class HitTruth:
    """Changed voxels of 5 cm in the map frame. A voxel comes once for each thing and visit that it was hit in."""

    keys: Keys  #: (V,)
    visit: NDArray[np.int8]  #: (V,) values of Visit: in which the thing stands there
    object_ids: NDArray[np.int32]  #: (V,)
    decidable: Bools  #: (V,) whether the other visit's rays went through
    surface: (
        Keys  #: (S,) ascending: of all surfaces that stand in one visit only, hit or not, if by over 2 cm
    )
    things: tuple[EditedThing, ...]

    def rows(self, visit: Visit, object_id: int | None = None) -> NDArray[np.intp]:
        """Return the decidable voxels of one visit, or of one thing in it: (n,)"""
        chosen = self.decidable & (self.visit == visit)
        return np.flatnonzero(chosen if object_id is None else chosen & (self.object_ids == object_id))

    def decidable_keys(self, visit: Visit | None = None) -> Keys:
        """Return the decidable voxels, of one visit or of both: (n,), ascending, each once."""
        chosen = self.decidable if visit is None else self.decidable & (self.visit == visit)
        return np.unique(self.keys[chosen])

    def kind_of(self) -> NDArray[np.int8]:
        """(V,) index into KINDS of what the voxel's thing underwent."""
        kinds = {thing.object_id: thing.kind for thing in self.things}
        return np.array([kinds[number] for number in self.object_ids.tolist()], np.int8)


def hit_truth(
    before: Scene,
    after: Scene,
    first: Sequence[SimulatedScan],
    second: Sequence[SimulatedScan],
    *,
    map_from_world: Matrix4,
) -> HitTruth:
    """Compare two visits by what their scans hit; scenes are in the world frame, the answer in the map's.

    A hit on a thing that was edited is changed if no surface of the other visit lies within 7.5 cm. It is decidable
    if at least two rays of the other visit pass within 4 cm of the voxel's middle and come back from at least 10 cm
    behind it. Rays that a mirror turned tell nothing.
    """
    things = edited_things(before, after)
    surface = changed_surface(before, after, map_from_world)
    parts = [
        _one_visit(visit, own, other, own_scans, other_scans, things, map_from_world)
        for visit, own, other, own_scans, other_scans in (
            (Visit.FIRST, before, after, first, second),
            (Visit.SECOND, after, before, second, first),
        )
    ]
    keys, object_ids, decidable = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    sides = np.repeat(np.array(list(Visit), np.int8), [len(part[0]) for part in parts])
    return HitTruth(
        keys=keys,
        visit=sides,
        object_ids=object_ids.astype(np.int32),
        decidable=decidable,
        surface=surface,
        things=things,
    )


def edited_things(before: Scene, after: Scene) -> tuple[EditedThing, ...]:
    """List what was added, removed and moved, by its id."""
    return tuple(
        EditedThing(
            object_id=item.object_id,
            kind=KINDS.index(kind),
            size=float(np.ptp(item.mesh.bounds, axis=0).max()),
        )
        for kind, item, _ in _edits(before, after)
    )


def _edits(
    before: Scene, after: Scene
) -> Iterator[tuple[ChangeKind, SceneObject, tuple[SceneObject | None, SceneObject | None]]]:
    """Yield each edit: its kind, the thing, and the thing as it stands in either scene."""
    old = {item.name: item for item in before.objects}
    new = {item.name: item for item in after.objects}
    for name in sorted(old.keys() | new.keys()):
        there, here = old.get(name), new.get(name)
        if there is None and here is not None:
            yield "add", here, (None, here)
        elif here is None and there is not None:
            yield "remove", there, (there, None)
        elif there is not None and here is not None and not same_place(there, here):
            yield "move", here, (there, here)


def changed_surface(before: Scene, after: Scene, map_from_world: Matrix4) -> Keys:
    """Return the voxels, map frame, of surfaces of edited things that lie over 2 cm from all of the other scene."""
    rng = np.random.default_rng(0)
    keys: list[Keys] = [np.empty(0, np.int64)]
    for _, _, places in _edits(before, after):
        for item, other in zip(places, (after, before), strict=True):
            if item is not None:
                points = sampled(item.mesh, rng)
                points = points[other.caster.distances(points) > SLIGHT]
                keys.append(Voxels.keys_of(transformed(points, map_from_world), size=CELL))
    return np.unique(np.concatenate(keys))


def _one_visit(
    visit: Visit,
    own: Scene,
    other: Scene,
    own_scans: Sequence[SimulatedScan],
    other_scans: Sequence[SimulatedScan],
    things: Sequence[EditedThing],
    map_from_world: Matrix4,
) -> tuple[Keys, NDArray[np.int64], Bools]:
    """Return the keys, object ids and decidability of what was changed where this visit hit it."""
    only_other = "add" if visit is Visit.FIRST else "remove"
    standing = [thing.object_id for thing in things if KINDS[thing.kind] != only_other]
    points, ids = _changed_hits(own, other, own_scans, standing)
    keys = Voxels.keys_of(transformed(points, map_from_world), size=CELL)
    each = np.unique(np.stack([keys, ids], axis=1), axis=0)
    places, where = np.unique(each[:, 0], return_inverse=True)
    middles = transformed(centers(places, CELL), inverse(map_from_world))
    told = passing_rays(middles, other, other_scans) >= FEWEST_RAYS
    return each[:, 0], each[:, 1], told[where.ravel()]


def _changed_hits(
    own: Scene, other: Scene, scans: Sequence[SimulatedScan], object_ids: Sequence[int]
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the returns (n, 3), world frame, from these things where the other visit has no surface; and whose."""
    points: list[Floats] = [np.empty((0, 3))]
    ids: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    for scan in scans:
        rows = np.flatnonzero(np.isin(scan.object_ids, object_ids))
        hits = scan.world_points[rows].astype(np.float64)
        if not len(hits):
            continue
        kept = (other.caster.distances(hits) > FAR) & (own.caster.distances(hits) < ON_SURFACE)
        points.append(hits[kept])
        ids.append(scan.object_ids[rows[kept]].astype(np.int64))
    return np.concatenate(points), np.concatenate(ids)


def passing_rays(places: Floats, scene: Scene, scans: Sequence[SimulatedScan]) -> NDArray[np.int64]:
    """Count the returned rays that tell of each place (P, 3), world frame, that nothing stands there: (P,)"""
    count = np.zeros(len(places), np.int64)
    for scan in scans if len(places) else ():
        count += _passing_rays_of(places, scan, scene.mirror_ids)
    return count


def _passing_rays_of(places: Floats, scan: SimulatedScan, mirror_ids: Sequence[int]) -> NDArray[np.int64]:
    returns = scan.world_points[~np.isin(scan.object_ids, mirror_ids)]
    return rays_past(places, scan.world_from_sensor[:3, 3], returns)


def rays_past(places: Floats, origin: Floats, returns: NDArray[np.floating]) -> NDArray[np.int64]:
    """Count for each place (P, 3) the returns (N, 3) of one scan from `origin` (3,) whose rays went through: (P,)"""
    rays = returns - origin
    ranges = np.linalg.norm(rays, axis=1)
    depths = np.linalg.norm(places - origin, axis=1)
    far = ranges > depths.min(initial=np.inf) + BEHIND
    near = np.flatnonzero((depths > PASSING) & (depths < ranges.max(initial=0.0)))
    counts = np.zeros(len(places), np.int64)
    if not far.any() or not len(near):
        return counts
    tree = cKDTree(rays[far] / ranges[far, None])
    chords = 2 * np.sin(np.arcsin(PASSING / depths[near]) / 2)
    toward = (places[near] - origin) / depths[near, None]
    passing = tree.query_ball_point(toward, chords)
    lengths = np.array([len(rows) for rows in passing], np.int64)
    rows = np.concatenate([np.asarray(rows, np.int64) for rows in passing])
    beyond = ranges[far][rows] > np.repeat(depths[near], lengths) + BEHIND
    counts[near] = np.bincount(np.repeat(np.arange(len(near)), lengths), weights=beyond, minlength=len(near))
    return counts
