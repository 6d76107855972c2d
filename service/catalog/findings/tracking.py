"""Objects over time: which sightings of all surveys of a map are one thing, and what became of it.

Plain values in, plain values out; `history` reads them from the database and writes the answer. The rules are told in
docs/decisions/0018-objects-over-time.md.

A sighting has a part *now*, where a thing stands that the map does not have there, or a part *before*, where the map
has a thing that is gone; of what moved it has both. Sightings are one object where parts of the same side are alike.
A side of an object stands until a visit that looked there finds it as in the map: what was not looked at stays as it
was told.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

from service.catalog.records import ObjectStatus, Vector3

Side = Literal["now", "before"]
Verdict = Literal["seen", "gone", "not_looked"]

MIN_REACH = 0.3  #: metres; how far apart the centers of two sightings of a small thing may be
MAX_SIZE_RATIO = 2.0  #: of each side of the box; what is seen from one side only looks smaller
SIZE_SLACK = 0.1  #: metres, added to each side before the ratio: two voxels
MIN_LOOK = 0.5  #: mean share observed of the tiles that a part touches; less is no look
CELL = 1.0  #: metres; only how fast it goes depends on it
SETTLED = 3  #: looks in a row that see a thing which came back; then it stays


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """One place of a sighting: an upright box, map frame, metres."""

    center: Vector3
    size: Vector3  #: along the axes of the box, the last is its height
    yaw: float  #: radians, counter-clockwise
    tiles: tuple[str, ...]  #: ids of the tiles that it touches


Parts = Mapping[Side, Part]  #: one or two


@dataclass(frozen=True, kw_only=True, slots=True)
class Sighting:
    """An object of one survey."""

    number: int
    parts: Parts
    object_id: str | None = None  #: that it had before


@dataclass(frozen=True, kw_only=True, slots=True)
class Visit:
    """A survey that tells objects."""

    survey_id: str
    captured_at: datetime
    map_version: int  #: that it was compared with
    sightings: tuple[Sighting, ...]
    observed: Mapping[str, float]  #: share observed by tile id, 0..1; a tile that is missing counts 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Accepted:
    """What a version of the map took over of a survey."""

    version: int
    parts: tuple[Parts, ...]  #: of each object


@dataclass(frozen=True, kw_only=True, slots=True)
class Track:
    """One object over all surveys."""

    object_id: str | None  #: None: a new one, which the caller names
    sightings: tuple[tuple[Visit, Sighting], ...]  #: in order of time; one visit may have two, one a side
    sides: frozenset[Side]  #: that stand; once it has gone again, those that stood when it was seen last
    status: ObjectStatus
    last_known: ObjectStatus  #: as the latest visit that looked there tells it
    transient: bool  #: it comes and goes
    last_looked: datetime
    accepted_in_version: int | None

    @property
    def visits(self) -> int:
        """The number of visits that saw it."""
        return len({visit.survey_id for visit, _ in self.sightings})


def track_objects(
    visits: Iterable[Visit], accepted: Sequence[Accepted] = (), *, ids: Sequence[str] = ()
) -> tuple[Track, ...]:
    """Return the objects of a map in the order in which they were first seen.

    The visits may come in any order. `ids` are those given so far, oldest first: each goes to the track that holds
    most of its sightings and has no older one.
    """
    in_order = sorted(visits, key=lambda visit: (visit.captured_at, visit.survey_id))
    trails = _trails(in_order, accepted)
    named = _named(trails, ids)
    return tuple(_track(trail, in_order, accepted, named.get(n)) for n, trail in enumerate(trails))


def difference(a: Part, b: Part) -> float | None:
    """Return how far two parts are from alike (metres), and None where they are not alike at all.

    The center of one lies in the box of the smaller one, or within MIN_REACH along each of its axes; and no side is
    more than MAX_SIZE_RATIO times the other's.
    """
    small, large = sorted((a, b), key=lambda part: (part.size[0] * part.size[1], part.center))
    east, north, up = (there - here for here, there in zip(small.center, large.center, strict=True))
    cos, sin = math.cos(small.yaw), math.sin(small.yaw)
    offset = (cos * east + sin * north, cos * north - sin * east, up)
    if any(abs(along) > max(MIN_REACH, side / 2) for along, side in zip(offset, small.size, strict=True)):
        return None
    sides = list(zip(_sides(a), _sides(b), strict=True))
    if any((max(pair) + SIZE_SLACK) > MAX_SIZE_RATIO * (min(pair) + SIZE_SLACK) for pair in sides):
        return None
    return math.hypot(*offset) + sum(abs(one - other) for one, other in sides) / len(sides)


def _sides(part: Part) -> tuple[float, float, float]:
    """Return longer and shorter level side and height: a box may be turned by a right angle and be the same."""
    one, other, height = part.size
    return max(one, other), min(one, other), height


@dataclass(kw_only=True, slots=True)
class _Trail:
    """A track in the making: its sightings so far, and the latest place on each side."""

    sightings: list[tuple[Visit, Sighting]] = field(default_factory=list)
    parts: dict[Side, Part] = field(default_factory=dict)

    def add(self, visit: Visit, sighting: Sighting) -> None:
        """Take a sighting on."""
        self.sightings.append((visit, sighting))
        self.parts |= sighting.parts

    def take_over(self, other: _Trail) -> None:
        """Take the sightings of a trail that turned out to be the other side of the same thing."""
        self.sightings = sorted(
            [*self.sightings, *other.sightings],
            key=lambda seen: (seen[0].captured_at, seen[0].survey_id, seen[1].number),
        )
        self.parts |= other.parts
        other.sightings, other.parts = [], {}

    @property
    def version(self) -> int:
        """Of the map, that its latest sighting was compared with."""
        return self.sightings[-1][0].map_version


@dataclass(kw_only=True, slots=True)
class _Trails:
    """The trails so far, and which of them were ever near a place: most pairs of parts are never compared."""

    trails: list[_Trail] = field(default_factory=list)
    cells: dict[tuple[int, int], set[int]] = field(default_factory=dict)  #: of the ground, CELL metres wide

    def add(self, number: int | None, visit: Visit, sighting: Sighting) -> None:
        """Go on from a trail, or begin one."""
        if number is None:
            number = len(self.trails)
            self.trails.append(_Trail())
        self.trails[number].add(visit, sighting)
        for part in sighting.parts.values():
            self.cells.setdefault(_cell(part.center), set()).add(number)

    def take_over(self, older: int, newer: int) -> None:
        """Make two trails one."""
        for part in self.trails[newer].parts.values():
            self.cells.setdefault(_cell(part.center), set()).add(older)
        self.trails[older].take_over(self.trails[newer])

    def near(self, part: Part) -> list[int]:
        """Return the trails that may be alike to a part: no farther than the largest box that is."""
        reach = math.sqrt(2) * max(MIN_REACH, max(part.size[:2]) + SIZE_SLACK)
        x, y, z = part.center
        (i0, j0), (i1, j1) = _cell((x - reach, y - reach, z)), _cell((x + reach, y + reach, z))
        cells = itertools.product(range(i0, i1 + 1), range(j0, j1 + 1))
        return sorted(set().union(*(self.cells.get(cell, ()) for cell in cells)))


def _cell(center: Vector3) -> tuple[int, int]:
    return math.floor(center[0] / CELL), math.floor(center[1] / CELL)


@dataclass(frozen=True, order=True, slots=True)
class _Match:
    """A part of a trail and one of a sighting that are alike; the best comes first."""

    difference: float
    trail: int
    sighting: int
    side: Side


def _trails(visits: Sequence[Visit], accepted: Sequence[Accepted]) -> list[_Trail]:
    known = _Trails()
    for visit in visits:
        matched = _matched(_matches(known, visit, accepted))
        going_on: dict[int, set[Side]] = {}
        for n in sorted(range(len(visit.sightings)), key=lambda n: _turn(n, matched.get(n, {}))):
            sides = visit.sightings[n].parts.keys()
            number = _joined(known, matched.get(n, {}), sides, going_on)
            known.add(number, visit, visit.sightings[n])
            if number is not None:
                going_on.setdefault(number, set()).update(sides)
    return sorted((trail for trail in known.trails if trail.sightings), key=_begin)


def _turn(n: int, matched: Mapping[Side, int]) -> tuple[int, bool, int]:
    """Return when a sighting takes its turn: one that has no choice first, of those what stands where it stood."""
    return len(matched), "now" not in matched, n


def _begin(trail: _Trail) -> tuple[datetime, str, int]:
    visit, sighting = trail.sightings[0]
    return visit.captured_at, visit.survey_id, sighting.number


def _matches(known: _Trails, visit: Visit, accepted: Sequence[Accepted]) -> list[_Match]:
    """Return every pair of parts that are alike, best first; a version that took the thing over stands between none."""
    found = []
    for n, sighting in enumerate(visit.sightings):
        for side, part in sighting.parts.items():
            for t in known.near(part):
                trail = known.trails[t]
                if side not in trail.parts:
                    continue
                off = difference(trail.parts[side], part)
                if off is not None and not _parted(trail, visit, side, accepted):
                    found.append(_Match(off, t, n, side))
    return sorted(found)


def _parted(trail: _Trail, visit: Visit, side: Side, accepted: Sequence[Accepted]) -> bool:
    """Tell whether a version between the two took over what the trail has on this side."""
    low, high = sorted((trail.version, visit.map_version))
    return any(low < taken.version <= high and _holds(taken, {side: trail.parts[side]}) for taken in accepted)


def _holds(taken: Accepted, parts: Parts) -> bool:
    """Tell whether a version took over a thing that is alike on a side."""
    return any(
        side in theirs and difference(part, theirs[side]) is not None
        for theirs in taken.parts
        for side, part in parts.items()
    )


def _matched(matches: Iterable[_Match]) -> dict[int, dict[Side, int]]:
    """Return the trail of each side of each sighting: best match first, each part once."""
    taken: set[tuple[int, Side]] = set()
    matched: dict[int, dict[Side, int]] = {}
    for match in matches:
        sides = matched.setdefault(match.sighting, {})
        if (match.trail, match.side) in taken or match.side in sides:
            continue
        taken.add((match.trail, match.side))
        sides[match.side] = match.trail
    return matched


def _joined(
    known: _Trails,
    matched: Mapping[Side, int],
    sides: Set[Side],
    going_on: Mapping[int, Set[Side]],
) -> int | None:
    """Return the trail that a sighting with these sides goes on from, None for a new one.

    `matched` holds the better match first, `going_on` the sides that this visit has told of trails so far. What was told
    as one thing that came and another that went, and is told as one that moved, becomes one trail. Where the sides lead
    to two things that both have moved, it is one that no sighting of this visit went on from. Two sightings of a visit
    are of one trail only where each tells the other side of it: a thing does not stand in two places.
    """
    found = list(dict.fromkeys(matched.values()))
    if len(found) == 2 and not known.trails[found[0]].parts.keys() & known.trails[found[1]].parts.keys():
        older, newer = sorted(found)
        known.take_over(older, newer)
        return older
    free = [number for number in found if number not in going_on]
    other_side = [number for number in found if not going_on.get(number, set()) & sides]
    return next(iter(free + other_side), None)


def _named(trails: Sequence[_Trail], ids: Sequence[str]) -> dict[int, str]:
    """Return the id of each trail that has one, from the oldest id to the newest."""
    held: dict[str, Counter[int]] = {}
    for n, trail in enumerate(trails):
        for _, sighting in trail.sightings:
            if sighting.object_id is not None:
                held.setdefault(sighting.object_id, Counter())[n] += 1
    named: dict[int, str] = {}
    for object_id in dict.fromkeys([*ids, *sorted(held)]):
        free = {n: count for n, count in held.get(object_id, Counter()).items() if n not in named}
        if free:
            named[max(free, key=lambda n: (free[n], -n))] = object_id
    return named


def _track(
    trail: _Trail, visits: Sequence[Visit], accepted: Sequence[Accepted], object_id: str | None
) -> Track:
    newest = max(visit.map_version for visit, _ in trail.sightings)
    taken = [one.version for one in accepted if one.version > newest and _holds(one, trail.parts)]
    version = min(taken, default=None)
    verdicts, sides = _verdicts(trail, visits, accepted, version)
    looks = [(visit, verdict) for visit, verdict in verdicts if verdict != "not_looked"]
    last_known = _status([verdict for _, verdict in looks])
    status: ObjectStatus = "unknown" if verdicts[-1][1] == "not_looked" else last_known
    return Track(
        object_id=object_id,
        sightings=tuple(trail.sightings),
        sides=sides,
        status=status if version is None else "accepted",
        last_known=last_known if version is None else "accepted",
        transient=comes_and_goes([verdict for _, verdict in looks]),
        last_looked=looks[-1][0].captured_at,
        accepted_in_version=version,
    )


def _verdicts(
    trail: _Trail, visits: Sequence[Visit], accepted: Sequence[Accepted], accepted_in: int | None
) -> tuple[list[tuple[Visit, Verdict]], frozenset[Side]]:
    """Return what each visit from the first sighting on says, and the sides that stand in the end.

    A visit that was compared with a map which has the thing, from version `accepted_in` on, has no say.
    """
    seen: dict[str, list[Parts]] = {}
    for visit, sighting in trail.sightings:
        seen.setdefault(visit.survey_id, []).append(sighting.parts)
    standing = _Standing()
    verdicts: list[tuple[Visit, Verdict]] = []
    for visit in visits[visits.index(trail.sightings[0][0]) :]:
        if accepted_in is not None and visit.map_version >= accepted_in:
            continue
        verdicts.append((visit, standing.after(visit, seen.get(visit.survey_id, ()), accepted)))
    return verdicts, frozenset(standing.sides)


@dataclass(kw_only=True, slots=True)
class _Standing:
    """Which sides of an object stand, visit after visit."""

    sides: set[Side] = field(default_factory=set)  #: that stood when it was seen last
    open: set[Side] = field(
        default_factory=set
    )  #: of these, those that no look has found as in the map since
    parts: dict[Side, Part] = field(default_factory=dict)
    versions: dict[Side, int] = field(default_factory=dict)  #: of the map, that each was told against

    def after(self, visit: Visit, seen: Sequence[Parts], accepted: Sequence[Accepted]) -> Verdict:
        """Take in what a visit says, whose sightings of the object have these parts; return whether it is there."""
        self.open -= {side for side in self.open if self._in_map(side, visit.map_version, accepted)}
        looked = {side for side in self.sides if _observed(self.parts[side], visit) >= MIN_LOOK}
        asked = set(self.open or self.sides)
        self.open -= looked
        for parts in seen:
            self.open |= parts.keys()
            self.parts |= parts
            self.versions |= dict.fromkeys(parts, visit.map_version)
        if seen:
            self.sides = set(self.open)
            return "seen"
        return "gone" if asked <= looked else "not_looked"

    def _in_map(self, side: Side, version: int, accepted: Sequence[Accepted]) -> bool:
        """Tell whether a version of the map has what was told of a side against an earlier one."""
        part, told = {side: self.parts[side]}, self.versions[side]
        return any(told < taken.version <= version and _holds(taken, part) for taken in accepted)


def _observed(part: Part, visit: Visit) -> float:
    """Return the mean share observed of the tiles that a part touches, 0 where it touches none."""
    shares = [visit.observed.get(tile, 0.0) for tile in part.tiles]
    return sum(shares) / len(shares) if shares else 0.0


def _status(looks: Sequence[Verdict]) -> ObjectStatus:
    if looks[-1] == "gone":
        return "gone_again"
    return "new" if looks.count("seen") == 1 else "still_there"


def comes_and_goes(looks: Sequence[Verdict]) -> bool:
    """Tell whether a thing is transient: it was seen, gone and seen again, and has not settled since.

    It has settled when SETTLED looks in a row have seen it. A thing that went once and did not come back is none:
    that is a change which was undone.
    """
    came_back, run = False, 1
    for earlier, later in itertools.pairwise(looks):
        run = run + 1 if later == earlier else 1
        if (earlier, later) == ("gone", "seen"):
            came_back = True
        if later == "seen" and run >= SETTLED:
            came_back = False
    return came_back
