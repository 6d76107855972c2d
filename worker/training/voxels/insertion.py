"""Insertion: a solid put into a real scan, with its shadow; and samples of a site's own scans that come of it.

Every return whose ray meets the solid first is replaced by one on the solid, with range noise. So a scan keeps its
density, its noise and its gaps, and nothing behind the solid is hit any more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.poses import exponential, transformed
from worker.cloud.seen import PlacedScan, Seen
from worker.cloud.sight import Sights
from worker.cloud.types import Bools, Floats, Matrix4, Points
from worker.cloud.voxel_keys import near, rows_of
from worker.cloud.voxels import Voxels
from worker.detectors.voxels.evidence import EvidenceSettings
from worker.training.voxels.samples import MISSING, THERE, UNKNOWN, VoxelSample
from worker.training.voxels.solids import Box, CloudObject, Cylinder, Solid, chair, spheres_meet, table

RANGE_SIGMA = 0.01  #: metres, of the noise of a return on a solid
_MARGIN = 0.02  # metres that a solid must lie before a return to take its place
_CLEAR = 0.05  # metres around a solid that must be free of other things
_STEP = 0.04  # metres above the floor from which on things are in its way
_TRIES = 40  # draws of a place for a solid
_FEWEST = 30  # returns of all scans that a solid must take
_JUDGED = 0.8  # share of the places in a solid that scans must have looked at
_FREE = 0.3  # and of those seen through; what is so low that the floor behind it is near has few
_NEAREST = 0.6  # metres between a sensor and the surface of a solid
_DROP = 2.5  # metres that the floor may lie under a free place


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class InsertedScan:
    """A scan in the map frame with solids in it."""

    points: Points  #: (N, 3) float32, metres, map frame
    sensor_origin: Floats | None  #: (3,) metres, map frame
    owner: NDArray[np.int32]  #: (N,) index of the solid that a return lies on, -1: none

    @classmethod
    def of(
        cls,
        scan: PlacedScan,
        solids: Sequence[Solid],
        rng: np.random.Generator,
        *,
        range_sigma: float = RANGE_SIGMA,
    ) -> InsertedScan:
        """Put solids into a scan; one whose sensor's place nobody knows stays as it is."""
        if scan.sensor_origin is None:
            return cls(points=scan.points, sensor_origin=None, owner=np.full(len(scan.points), -1, np.int32))
        points, owner = inserted(scan.points, scan.sensor_origin, solids, rng, range_sigma=range_sigma)
        return cls(points=points, sensor_origin=scan.sensor_origin, owner=owner)

    def subset(self, kept: Bools) -> InsertedScan:
        """Return the same with some returns (N,) alone."""
        return replace(self, points=self.points[kept], owner=self.owner[kept])

    def moved(self, motion: Matrix4) -> InsertedScan:
        """Return the same, moved within the map frame by a rigid motion (4, 4)."""
        origin = self.sensor_origin
        return replace(
            self,
            points=transformed(self.points, motion).astype(np.float32),
            sensor_origin=None if origin is None else transformed(origin[None], motion)[0],
        )


def inserted(
    points: NDArray[Any],
    origin: Floats,
    solids: Sequence[Solid],
    rng: np.random.Generator,
    *,
    range_sigma: float = RANGE_SIGMA,
) -> tuple[Points, NDArray[np.int32]]:
    """Put solids into the returns (N, 3), metres, of a scan from `origin` (3,), all in the map frame.

    Returns the points (N, 3) float32, and of each the index (N,) of the solid that it now lies on, -1 where that is
    none. A direction without a return stays without one, for nobody knows that it was asked.
    """
    exact = np.asarray(points, np.float64)
    rays = exact - origin
    ranges = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(ranges, 1e-9)[:, None]
    nearest, owner = ranges - _MARGIN, np.full(len(exact), -1, np.int32)
    for number, solid in enumerate(solids):
        rows = _towards(solid, origin, rays)
        told = solid.ranges(origin, rays[rows])
        first = told < nearest[rows]
        nearest[rows[first]], owner[rows[first]] = told[first], number
    hit = np.flatnonzero(owner >= 0)
    length = nearest[hit] + rng.normal(0.0, range_sigma, len(hit))
    result = np.array(points, np.float32)
    result[hit] = origin + rays[hit] * length[:, None]
    return result, owner


def _towards(solid: Solid, origin: Floats, rays: Floats) -> NDArray[np.intp]:
    """Return the rows of the unit rays (N, 3) from `origin` that meet the sphere around a solid."""
    away = solid.middle - origin
    distance = float(np.linalg.norm(away))
    if distance <= solid.radius:
        return np.arange(len(rays))
    least = np.sqrt(1 - (solid.radius / distance) ** 2)
    return np.flatnonzero(rays @ (away / distance) >= least - 1e-6)


class FreeRoom:
    """What scans in one frame prove free, and where a new thing can stand in their sight."""

    def __init__(self, scans: Sequence[PlacedScan], voxel_size: float = 0.05) -> None:
        """Take scans, map frame; those without a sensor's place prove nothing. Raises ValueError where all are so."""
        self._scans = [scan for scan in scans if scan.sensor_origin is not None and len(scan.points)]
        if not self._scans:
            raise ValueError("no scan has a sensor's place, so nothing is known to be free")
        self._origins = np.stack(
            [scan.sensor_origin for scan in self._scans if scan.sensor_origin is not None]
        )
        seen = Seen.of(scans, voxel_size=voxel_size)
        self._occupied = seen.points.astype(np.float64)
        if seen.sights is None:
            raise ValueError("no scan has a sensor's place, so nothing is known to be free")
        self._sights: Sights = seen.sights

    def place(self, rng: np.random.Generator) -> Floats:
        """Draw a place (3,) that a scan saw through: on a return's ray, somewhere before it."""
        scan = self._scans[int(rng.integers(len(self._scans)))]
        origin = np.asarray(scan.sensor_origin, np.float64)
        return np.asarray(
            origin + (scan.points[rng.integers(len(scan.points))] - origin) * rng.uniform(0.3, 0.9)
        )

    def support(self, place: Floats, reach: float) -> float | None:
        """Return the height of the highest thing under a place (3,), within `reach` metres to all sides; or None."""
        off = self._occupied - place
        under = (np.abs(off[:, :2]) <= reach).all(axis=1) & (off[:, 2] < 0) & (off[:, 2] > -_DROP)
        return float(self._occupied[under, 2].max()) if under.sum() >= 3 else None

    def fits(self, solid: Solid, *, bottom: float | None) -> bool:
        """Tell whether a solid stands in free room, in sight, and no nearer to a sensor than it should.

        `bottom` is the height that it rests on, metres; None: it hangs in mid-air.
        """
        clear = np.linalg.norm(self._origins - solid.middle, axis=1) > solid.radius + _NEAREST
        if not clear.all():
            return False
        around = self._occupied[(np.abs(self._occupied - solid.middle) < solid.radius + _CLEAR).all(axis=1)]
        if bottom is not None:
            around = around[around[:, 2] > bottom + _STEP]
        if solid.holds(around, _CLEAR).any():
            return False
        verdicts = self._sights.verdicts(solid.places())
        looked_at = verdicts.judged.mean() >= _JUDGED and (verdicts.through > 0).mean() >= _FREE
        return bool(looked_at) and self._returns(solid) >= _FEWEST

    def _returns(self, solid: Solid) -> int:
        """Count the returns of all scans that a solid would take."""
        count = 0
        for scan, origin in zip(self._scans, self._origins, strict=True):
            rays = scan.points.astype(np.float64) - origin
            ranges = np.linalg.norm(rays, axis=1)
            rays /= np.maximum(ranges, 1e-9)[:, None]
            rows = _towards(solid, origin, rays)
            count += int((solid.ranges(origin, rays[rows]) < ranges[rows] - _MARGIN).sum())
        return count


def random_solids(
    scans: Sequence[PlacedScan] | FreeRoom,
    rng: np.random.Generator,
    count: int,
    size: tuple[float, float] = (0.12, 1.2),
    *,
    things: Sequence[CloudObject] = (),
) -> list[Solid]:
    """Draw up to `count` solids at places that the scans prove free and see; fewer where no place is found.

    Extents lie between the two of `size` (metres), small ones as often as large. They are boxes, cylinders, tables and
    chairs; `things` are drawn from as well where there are any, two of three times. Two of three stand on what is under
    them, the others hang. Raises ValueError where no scan has its sensor's place.
    """
    room = scans if isinstance(scans, FreeRoom) else FreeRoom(scans)
    solids: list[Solid] = []
    for _ in range(count):
        for _ in range(_TRIES):
            solid, bottom = _drawn(room, rng, size, things)
            if solid is not None and not spheres_meet(solid, solids) and room.fits(solid, bottom=bottom):
                solids.append(solid)
                break
    return solids


def _drawn(
    room: FreeRoom, rng: np.random.Generator, size: tuple[float, float], things: Sequence[CloudObject]
) -> tuple[Solid | None, float | None]:
    """Draw a solid and the height that it stands on, None if it hangs; no solid where nothing is under it."""
    extents = np.exp(rng.uniform(np.log(size[0]), np.log(size[1]), 3))
    thing = things[int(rng.integers(len(things)))] if things and rng.random() < 2 / 3 else None
    half = extents / 2 if thing is None else thing.half
    place, bottom = room.place(rng), None
    if rng.random() < 2 / 3:
        bottom = room.support(place, float(np.hypot(half[0], half[1])))
        if bottom is None:
            return None, None
        place = np.array([place[0], place[1], bottom + half[2]])
    yaw = float(rng.uniform(0, 2 * np.pi))
    return (_shape(place, extents, yaw, rng) if thing is None else thing.moved(place, yaw)), bottom


def _shape(middle: Floats, extents: Floats, yaw: float, rng: np.random.Generator) -> Solid:
    """Draw what a thing of these extents (3,) is; tables and chairs where it is large enough to have legs."""
    kinds = ["box", "cylinder", "table", "chair"] if extents.min() > 0.25 else ["box", "cylinder"]
    kind = str(rng.choice(kinds))
    if kind == "table":
        return table(middle, extents, yaw)
    if kind == "chair":
        return chair(middle, extents, yaw)
    if kind == "cylinder":
        return Cylinder(middle=middle, girth=float(extents[:2].min()) / 2, half_height=float(extents[2]) / 2)
    return Box(middle=middle, half=extents / 2, yaw=yaw)


@dataclass(frozen=True, kw_only=True, slots=True)
class SiteSettings:
    """How a site's own scans are made into samples."""

    rounds: int = 16  #: pairs of visits, each compared both ways
    solids: int = 8  #: at most so many are drawn a round
    quiet: float = 0.25  #: share of the rounds without any
    blind: float = 0.15  #: share of the rounds as if nobody knew the sensors' places
    shift: float = 0.01  #: metres, the most that a visit lies off
    turn: float = 0.1  #: degrees, the most that a visit is turned
    range_sigma: tuple[float, float] = (0.005, 0.02)  #: metres, of returns on solids; drawn a round
    size: tuple[float, float] = (0.12, 1.2)  #: metres, of a solid


def site_samples(
    scans: Sequence[PlacedScan],
    voxel_size: float,
    settings: EvidenceSettings,
    rng: np.random.Generator,
    *,
    site: SiteSettings = SiteSettings(),
    things: Sequence[CloudObject] = (),
) -> list[VoxelSample]:
    """Make samples of one map's own scans, map frame: two parts of them taken as two visits, with solids in either.

    In the real scans nothing has changed from part to part, so what is found there is this site's noise. A sample's
    `building` is the number of its round. Scans without their sensors' places get no solids.
    """
    samples = []
    room = FreeRoom(scans) if any(scan.sensor_origin is not None for scan in scans) else None
    for number in range(site.rounds):
        solids: list[Solid] = []
        if room is not None and rng.random() >= site.quiet:
            count = int(rng.integers(1, site.solids + 1))
            solids = random_solids(room, rng, count, site.size, things=things)
        visits = _two_visits(scans, number, solids, site, rng)
        if rng.random() < site.blind:
            visits = [[replace(scan, sensor_origin=None) for scan in visit] for visit in visits]
        samples += compared(visits[0], visits[1], voxel_size, settings, number=number)
    return samples


def compared(
    first: Sequence[InsertedScan],
    second: Sequence[InsertedScan],
    voxel_size: float,
    settings: EvidenceSettings,
    *,
    number: int = 0,
) -> list[VoxelSample]:
    """Compare two visits both ways: what stands on a solid of the one is missing from the other."""
    sides = [(visit, Seen.of(visit, voxel_size=voxel_size)) for visit in (first, second)]
    samples = []
    for (visit, own), (_, other) in (sides, sides[::-1]):
        truth = missing_labels(visit, own, other, reach=settings.reach)
        sample = VoxelSample.of(own, other, truth, settings, building=number)
        if sample is not None:
            samples.append(sample)
    return samples


def missing_labels(
    visit: Sequence[InsertedScan], own: Seen, other: Seen, *, reach: int = 1
) -> NDArray[np.int8]:
    """Return the truth (V,) about the voxels of `own`, seen by the visit, of which `other` has none of the solids.

    MISSING is where at least half of the returns lie on solids, UNKNOWN where fewer do or where the other visit hit
    something within `reach` voxels, THERE everything else.
    """
    on_solids = np.zeros(len(own.keys))
    for scan in visit:
        rows = rows_of(Voxels.keys_of(scan.points, size=own.voxel_size), own.keys)
        on_solids += np.bincount(rows, weights=scan.owner >= 0, minlength=len(on_solids))
    truth = np.full(len(on_solids), THERE, np.int8)
    truth[on_solids > 0] = UNKNOWN
    truth[(2 * on_solids >= own.hits) & ~near(own.keys, other.keys, reach)] = MISSING
    return truth


def _two_visits(
    scans: Sequence[PlacedScan],
    number: int,
    solids: Sequence[Solid],
    site: SiteSettings,
    rng: np.random.Generator,
) -> list[list[InsertedScan]]:
    """Share the scans and the solids out among two visits, each a little off its place."""
    visits, side = [], rng.integers(0, 2, len(solids))
    sigma = float(rng.uniform(*site.range_sigma))
    for part, rows in enumerate(_split(len(scans), number, rng)):
        mine = [solid for solid, which in zip(solids, side, strict=True) if which == part]
        visit = [InsertedScan.of(scans[row], mine, rng, range_sigma=sigma) for row in rows]
        if len(scans) == 1:  # the other visit has the same returns: leave some out, independently
            visit = [scan.subset(rng.random(len(scan.points)) < rng.uniform(0.5, 0.9)) for scan in visit]
        motion = _jitter(visit, site, rng)
        visits.append([scan.moved(motion) for scan in visit])
    return visits


def _split(count: int, number: int, rng: np.random.Generator) -> tuple[list[int], list[int]]:
    """Share scans out among two visits, by the number of the round: interleaved, one against the rest, and so on."""
    rows = list(range(count))
    if count == 1:
        return rows, rows
    kind = number % 4
    if kind == 0:
        return rows[::2], rows[1::2]
    one = int(rng.integers(count))
    if kind == 1:
        return [row for row in rows if row != one], [one]
    if kind == 2:
        return [one], [one + 1 if one + 1 < count else one - 1]
    mixed = rng.permutation(count)
    return sorted(mixed[: count // 2].tolist()), sorted(mixed[count // 2 :].tolist())


def _jitter(visit: Sequence[InsertedScan], site: SiteSettings, rng: np.random.Generator) -> Matrix4:
    """Draw a small motion about the middle of a visit."""
    middle = np.mean(list(_middles(visit)), axis=0)
    shift = rng.normal(size=3)
    shift *= rng.uniform(0, site.shift) / np.linalg.norm(shift)
    turn = np.radians(rng.uniform(-site.turn, site.turn))
    motion = exponential(np.array([0.0, 0.0, turn, 0.0, 0.0, 0.0]))
    motion[:3, 3] = middle + shift - motion[:3, :3] @ middle
    return motion


def _middles(visit: Sequence[InsertedScan]) -> Iterator[Floats]:
    """Yield the sensor's place (3,) of each scan, or the mean of its points where nobody knows that."""
    for scan in visit:
        if scan.sensor_origin is not None:
            yield scan.sensor_origin
        elif len(scan.points):
            yield scan.points.mean(axis=0).astype(np.float64)
        else:
            yield np.zeros(3)
