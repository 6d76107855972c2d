"""Objects: connected regions of changed voxels, as things that appeared, disappeared or moved, with where they stand."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from worker.cloud.seen import Seen
from worker.cloud.settings import StrictModel
from worker.cloud.tiling import TileGrid
from worker.cloud.types import Bools, Floats, Points
from worker.cloud.voxel_keys import Keys, regions, rows_of
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Probabilities, VoxelScores
from worker.pipeline.results.places import Place, around, floor_below, place_of, within
from worker.pipeline.results.shapes import Motion, Shape, ShapeSettings, Surroundings, moved_things

ObjectKind = Literal["appeared", "disappeared", "moved"]

AROUND = 0.2  #: metres around an object's box, of which `observed_share` is taken
OVER = (
    0.1,
    0.3,
)  #: metres, level and up, around a larger part's box, where a smaller one is of the same thing
OVER_SHARE = 0.7  #: of the smaller part
MOVING_SHARE = 0.5  #: a region of which more moved during a visit is no object
SEEN_THROUGH = 90  #: percentile over an object's voxels, so that a few of them do not speak for all


class ObjectSettings(StrictModel):
    """What makes a region of changed voxels an object; a calibrated map puts its own values in place."""

    probability: float = Field(0.5, ge=0, le=1, description="a voxel counts from above this")
    min_voxels: int = Field(20, gt=0, description="a smaller region is no object")
    min_score: float = Field(0.0, ge=0, description="least sum of the voxels' probabilities")
    max_gap: float = Field(
        0.12, ge=0, description="metres between voxels of two regions of one kind that make one object"
    )
    shapes: ShapeSettings = Field(default_factory=ShapeSettings, description="what is taken for moved")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Region:
    """Changed voxels that hang together, each touching the next by a face, an edge or a corner."""

    rows: NDArray[np.int64]  #: (n,) in `VoxelScores.keys`, ascending
    probabilities: Probabilities  #: (n,)

    @property
    def score(self) -> float:
        """The sum of the voxels' probabilities."""
        return float(self.probabilities.sum())

    @classmethod
    def joined(cls, parts: Sequence[Region]) -> Region:
        """Return the voxels of all parts as one."""
        rows = np.concatenate([part.rows for part in parts])
        order = np.argsort(rows)
        return cls(
            rows=rows[order], probabilities=np.concatenate([part.probabilities for part in parts])[order]
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ChangeObject:
    """A thing that is not as it was."""

    number: int  #: 1, 2, ... the largest score first
    kind: ObjectKind
    now: Place | None  #: None where it disappeared
    before: Place | None  #: None where it appeared
    motion: Motion | None  #: of what moved
    score: float  #: sum of its voxels' probabilities, of both places
    probability: float  #: mean of the same
    observed_share: (
        float  #: of what lies around it, that the other visit could judge; of two places the lesser
    )
    scans_seen_through: (
        int  #: scans of the other visit that saw through it (90th percentile); of two places the more
    )

    @property
    def places(self) -> tuple[Place, ...]:
        """Where it was, then where it is."""
        return tuple(place for place in (self.before, self.now) if place is not None)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ChangeObjects:
    """All that changed, and what each of the V voxels belongs to."""

    objects: tuple[ChangeObject, ...]  #: by number
    moving: int  #: things that moved while a visit lasted, such as people; they are no objects
    voxel_size: float  #: metres
    keys: Keys  #: (V,) ascending
    now: NDArray[np.int32]  #: (V,) the number of the object that the survey's returns are of; 0: of none
    before: NDArray[np.int32]  #: (V,) likewise of the map's

    def counts(self) -> dict[str, int]:
        """Count the objects by kind, every kind named."""
        counts = Counter(thing.kind for thing in self.objects)
        return {kind: counts[kind] for kind in get_args(ObjectKind)}

    def outside(self, tile_ids: Collection[str]) -> ChangeObjects:
        """Return the objects that do not lie in these tiles alone; the others' voxels belong to none."""
        kept = tuple(
            thing
            for thing in self.objects
            if any(index not in tile_ids for place in thing.places for index in place.tiles)
        )
        numbers = [thing.number for thing in kept]
        return replace(
            self,
            objects=kept,
            now=np.where(np.isin(self.now, numbers), self.now, 0).astype(np.int32),
            before=np.where(np.isin(self.before, numbers), self.before, 0).astype(np.int32),
        )


def change_objects(
    comparison: Comparison, voxels: VoxelScores, settings: ObjectSettings | None = None
) -> ChangeObjects:
    """Make objects of what a detector says of voxels and what both visits saw.

    Raises ValueError where nobody kept what they saw, and for a changed voxel that its visit did not hit.
    """
    settings = settings or ObjectSettings()
    before, now = _sides(comparison, voxels)
    gone = before.parts(regions_of(voxels, voxels.disappeared, settings), max_gap=settings.max_gap)
    come = now.parts(regions_of(voxels, voxels.appeared, settings), max_gap=settings.max_gap)
    things = sorted(_things(before, now, gone, come, settings.shapes), key=lambda thing: -thing.score)
    return ChangeObjects(
        objects=tuple(thing.described(number) for number, thing in enumerate(things, start=1)),
        moving=moving_things(voxels, min_voxels=settings.min_voxels),
        voxel_size=before.seen.voxel_size,
        keys=voxels.keys,
        before=_numbered(len(voxels.keys), [thing.gone for thing in things]),
        now=_numbered(len(voxels.keys), [thing.come for thing in things]),
    )


def regions_of(voxels: VoxelScores, chances: Probabilities, settings: ObjectSettings) -> list[Region]:
    """Return the regions of voxels above the probability that are large and certain enough, the first voxel's first.

    `chances` (V,) are those of one kind, `voxels.appeared` or `voxels.disappeared`. Regions of which most moved during
    a visit are left out.
    """
    found = []
    for rows in _connected(voxels.keys, chances > settings.probability):
        region = Region(rows=rows, probabilities=chances[rows])
        large = len(rows) >= settings.min_voxels and region.score >= settings.min_score
        if large and voxels.moving[rows].mean() <= MOVING_SHARE:
            found.append(region)
    return found


def moving_things(voxels: VoxelScores, *, min_voxels: int) -> int:
    """Count what moved while a visit lasted: connected regions of at least `min_voxels` such voxels."""
    return sum(len(rows) >= min_voxels for rows in _connected(voxels.keys, voxels.moving))


def _connected(keys: Keys, chosen: Bools) -> list[NDArray[np.int64]]:
    """Return the rows of the chosen keys (V,), ascending, region by region."""
    rows = np.flatnonzero(chosen)
    count, labels = regions(keys[rows])
    order = np.argsort(labels, kind="stable")
    ends = np.cumsum(np.bincount(labels, minlength=count))
    return np.split(rows[order], ends[:-1]) if count else []


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Found:
    """A region and where it lies."""

    region: Region
    place: Place
    points: Floats  #: (n, 3) metres, map frame: the mean of the returns in each voxel
    observed_share: float
    scans_seen_through: int

    @property
    def shape(self) -> Shape:
        return Shape(points=self.points, center=self.place.center, size=self.place.size)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Thing:
    """A region that went, one that came, or both: one that was moved."""

    gone: _Found | None
    come: _Found | None
    motion: Motion | None = None

    @property
    def parts(self) -> list[_Found]:
        return [part for part in (self.gone, self.come) if part is not None]

    @property
    def score(self) -> float:
        return sum(part.region.score for part in self.parts)

    def described(self, number: int) -> ChangeObject:
        """Return it under its number."""
        probabilities = np.concatenate([part.region.probabilities for part in self.parts])
        return ChangeObject(
            number=number,
            kind="appeared" if self.gone is None else "disappeared" if self.come is None else "moved",
            now=None if self.come is None else self.come.place,
            before=None if self.gone is None else self.gone.place,
            motion=self.motion,
            score=float(probabilities.sum()),
            probability=float(probabilities.mean()),
            observed_share=min(part.observed_share for part in self.parts),
            scans_seen_through=max(part.scans_seen_through for part in self.parts),
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Side:
    """One visit and what is said of it: regions of what it alone hit become places."""

    grid: TileGrid
    seen: Seen
    floors: Points  #: (M, 3) of the map, in which a floor is looked for
    voxels: VoxelScores

    def parts(self, regions: Sequence[Region], *, max_gap: float) -> list[_Found]:
        """Look regions up in what the visit saw, those that lie near each other, or above, as one.

        Raises ValueError where it has not hit one of their voxels.
        """
        near = _joined_by(regions, _linked([self._points(region) for region in regions], max_gap))
        parts = [self.part(region) for region in near]
        above = _joined_by(
            near, [(a, b) for a, b in permutations(range(len(parts)), 2) if _is_over(parts[a], parts[b])]
        )
        return parts if len(above) == len(near) else [self.part(region) for region in above]

    def part(self, region: Region) -> _Found:
        """Describe where a region lies."""
        points = self._points(region)
        place = place_of(
            points,
            hits=int(self.seen.hits[self._rows(region)].sum()),
            floor=floor_below(points, self.floors, voxel_size=self.seen.voxel_size),
            grid=self.grid,
            voxel_size=self.seen.voxel_size,
        )
        through = np.percentile(self.voxels.seen_through[region.rows], SEEN_THROUGH)
        return _Found(
            region=region,
            place=place,
            points=points,
            observed_share=self._observed_share(place),
            scans_seen_through=int(through),
        )

    def surroundings(self) -> Surroundings:
        """Return all that the visit hit, and what of it the other could not judge."""
        rows = rows_of(self.seen.keys, self.voxels.keys)
        return Surroundings(
            points=self.seen.points,
            unjudged=(rows < 0) | ~self.voxels.judged[rows],
            voxel_size=self.seen.voxel_size,
        )

    def _rows(self, region: Region) -> NDArray[np.int64]:
        rows = rows_of(self.voxels.keys[region.rows], self.seen.keys)
        if (rows < 0).any():
            raise ValueError(f"{int((rows < 0).sum())} changed voxels were not hit by the visit they are of")
        return rows

    def _points(self, region: Region) -> Floats:
        points: Floats = self.seen.points[self._rows(region)].astype(np.float64)
        return points

    def _observed_share(self, place: Place) -> float:
        """Return the share of what the visit hit in and around a place that the other could judge."""
        reach = math.hypot(*place.size[:2]) / 2 + 2 * AROUND
        x, _, _ = place.center
        near = around(self.seen.points, x - reach, x + reach, voxel_size=self.seen.voxel_size)
        inside = within(place, self.seen.points[near], margin=(AROUND,) * 3)
        rows = rows_of(self.seen.keys[near][inside], self.voxels.keys)
        judged = self.voxels.judged[rows[rows >= 0]]
        return float(judged.mean()) if len(judged) else 0.0


def _linked(clouds: Sequence[Floats], max_gap: float) -> list[tuple[int, int]]:
    """Return the pairs of clouds (n, 3) with points within so many metres of each other."""
    if not clouds:
        return []
    owners = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    links = owners[KDTree(np.concatenate(clouds)).query_pairs(max_gap, output_type="ndarray")]
    return [(int(a), int(b)) for a, b in np.unique(links, axis=0) if a != b]


def _joined_by(regions: Sequence[Region], links: Sequence[tuple[int, int]]) -> list[Region]:
    """Return the regions, those that links connect as one."""
    if not links:
        return list(regions)
    rows, columns = np.array(links).T
    shape = (len(regions), len(regions))
    _, labels = connected_components(
        coo_matrix((np.ones(len(rows)), (rows, columns)), shape=shape), directed=False
    )
    return [
        Region.joined([region for region, its in zip(regions, labels, strict=True) if its == label])
        for label in np.unique(labels)
    ]


def _is_over(one: _Found, other: _Found) -> bool:
    """Tell whether most of a smaller part lies right over, under or in the box of a larger one: leaves over their pot."""
    if len(one.points) > len(other.points):
        return False
    inside = within(other.place, one.points, margin=(OVER[0], OVER[0], OVER[1]))
    return bool(inside.mean() >= OVER_SHARE)


def _sides(comparison: Comparison, voxels: VoxelScores) -> tuple[_Side, _Side]:
    before, now = comparison.reference.seen, comparison.current.seen
    if before is None or now is None:
        raise ValueError("objects need what both visits saw, and nobody kept it")
    return (
        _Side(grid=comparison.grid, seen=before, floors=before.points, voxels=voxels),
        _Side(grid=comparison.grid, seen=now, floors=before.points, voxels=voxels),
    )


def _things(
    before: _Side, now: _Side, gone: list[_Found], come: list[_Found], shapes: ShapeSettings
) -> list[_Thing]:
    """Return every region, alone or as one of the two places of what was moved."""
    visits = (before.surroundings(), now.surroundings())
    moved = moved_things([part.shape for part in gone], [part.shape for part in come], visits, shapes)
    paired_gone = {row for thing in moved for row in thing.gone}
    paired_come = {row for thing in moved for row in thing.come}
    things = [_Thing(gone=part, come=None) for row, part in enumerate(gone) if row not in paired_gone]
    things += [_Thing(gone=None, come=part) for row, part in enumerate(come) if row not in paired_come]
    for thing in moved:
        whole = _together(before, [gone[row] for row in thing.gone])
        arrived = _together(now, [come[row] for row in thing.come])
        things.append(_Thing(gone=whole, come=arrived, motion=thing.motion_of(whole.place.center)))
    return things


def _together(side: _Side, parts: Sequence[_Found]) -> _Found:
    return parts[0] if len(parts) == 1 else side.part(Region.joined([part.region for part in parts]))


def _numbered(count: int, parts: Sequence[_Found | None]) -> NDArray[np.int32]:
    numbers = np.zeros(count, np.int32)
    for number, part in enumerate(parts, start=1):
        if part is not None:
            numbers[part.region.rows] = number
    return numbers
