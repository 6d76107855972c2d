"""Objects: which of the things that were edited a method found, and which of what it found is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.benchmarks.revisit.answers import PredictedObject, VisitAnswer
from worker.benchmarks.revisit.plan import VisitPlan
from worker.benchmarks.revisit.tiles import binned
from worker.benchmarks.revisit.visits import Revisit
from worker.cloud.types import Bools
from worker.cloud.voxel_keys import Keys, near
from worker.simulation.hits import Visit
from worker.simulation.truth import KINDS

MIN_VOXELS = 40  #: decidable voxels of a region that is to be found, and voxels of an object that is counted
HARD_MIN_VOXELS = 12  #: the same in the hard part, whose small things have 12 to 30
COVERED = 0.25  #: share of a region's voxels that one object has to cover
TRUE = 0.5  #: share of an object's voxels that has to lie by a true change
MATCH, NEARBY = 1, 2  #: voxels; poses are off by a centimetre, and so are the surfaces
#: Edges of bins, by the decidable voxels of a region and by the longest edge of its thing in metres.
VOXEL_EDGES = (HARD_MIN_VOXELS, MIN_VOXELS, 100, 250, 600, np.inf)
SIZE_EDGES = (0.0, 0.2, 0.4, 0.7, 1.0, 1.5, np.inf)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TrueRegion:
    """A place where an edited thing stands in one visit only, of any size."""

    visit: int  #: number of the second visit
    object_id: int
    side: Visit  #: in which it stands there
    kind: str  #: as in KINDS
    size: float  #: metres, longest edge of the thing
    keys: Keys  #: (n,) decidable voxels, ascending


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Things:
    """What there was to find in some visits."""

    regions: tuple[TrueRegion, ...]  #: of at least `min_voxels` decidable voxels
    case: tuple[str, ...]  #: of each visit
    building: tuple[str, ...]  #: of each visit
    quiet: tuple[bool, ...]  #: of each visit: nothing was edited
    min_voxels: int  #: of a region, and of an object that is counted

    @property
    def moved(self) -> tuple[tuple[int, int], ...]:
        """Rows in `regions` of where a moved thing was, and where it is, if both could be decided."""
        where = {
            (region.visit, region.object_id, region.side): row for row, region in enumerate(self.regions)
        }
        pairs = [
            (row, where.get((number, thing, Visit.SECOND)))
            for (number, thing, side), row in where.items()
            if side is Visit.FIRST and self.regions[row].kind == "move"
        ]
        return tuple((first, second) for first, second in pairs if second is not None)

    def groups(self) -> dict[str, dict[str, Bools]]:
        """Return the regions (R,) of each group, by what they are grouped by."""
        columns = {
            "kind": [f"{region.kind}, {_gone_or_come(region.side)}" for region in self.regions],
            "case": [self.case[region.visit] for region in self.regions],
            "building": [self.building[region.visit] for region in self.regions],
        }
        groups = {
            by: {name: np.array([one == name for one in names]) for name in dict.fromkeys(sorted(names))}
            for by, names in columns.items()
        }
        voxels = np.array([len(region.keys) for region in self.regions], np.float64)
        metres = np.array([region.size for region in self.regions], np.float64)
        return {
            **groups,
            "voxels": binned(voxels, VOXEL_EDGES, "{:g}"),
            "size": binned(metres, SIZE_EDGES, "{:g} m"),
        }


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ObjectFigures:
    """What a method found of the regions (R,), and its objects (P,) that are large enough, in all visits."""

    found: Bools  #: (R,)
    told_moved: Bools  #: (M,) of `Things.moved`, told as one thing that moved
    true: Bools  #: (P,)
    of_visit: NDArray[np.int64]  #: (P,) number of the visit
    any_size: NDArray[np.int64]  #: (visits,) objects of any size, as a user is told of them

    def document(self, things: Things) -> Document:
        """Return it as JSON."""
        quiet = np.array(things.quiet)
        false = np.bincount(self.of_visit[~self.true], minlength=len(quiet))
        return {
            "min_voxels": things.min_voxels,
            "regions": len(self.found),
            "recall": _share(self.found),
            "objects": len(self.true),
            "precision": _share(self.true),
            "false_objects": int((~self.true).sum()),
            "false_objects_a_quiet_visit": float(false[quiet].mean()) if quiet.any() else None,
            "quiet_visits": int(quiet.sum()),
            "quiet_visits_with_an_object": int((self.any_size[quiet] > 0).sum()),
            "moved": len(self.told_moved),
            "told_as_moved": _share(self.told_moved),
            "groups": {
                by: {
                    name: {"regions": int(rows.sum()), "found": int(self.found[rows].sum())}
                    for name, rows in groups.items()
                }
                for by, groups in things.groups().items()
            },
        }


def things_of(
    plans: Sequence[VisitPlan], visits: Sequence[Revisit], *, min_voxels: int = MIN_VOXELS
) -> Things:
    """List what there was to find: regions of at least so many decidable voxels."""
    return Things(
        min_voxels=min_voxels,
        regions=tuple(
            region
            for number, revisit in enumerate(visits)
            for region in _regions(number, revisit)
            if len(region.keys) >= min_voxels
        ),
        case=tuple(plan.case for plan in plans),
        building=tuple(plan.site.kind for plan in plans),
        quiet=tuple(plan.quiet for plan in plans),
    )


def _regions(number: int, revisit: Revisit) -> list[TrueRegion]:
    truth = revisit.truth
    regions = []
    for thing in truth.things:
        for side in Visit:
            keys = np.unique(truth.keys[truth.rows(side, thing.object_id)])
            regions.append(
                TrueRegion(
                    visit=number,
                    object_id=thing.object_id,
                    side=side,
                    kind=KINDS[thing.kind],
                    size=thing.size,
                    keys=keys,
                )
            )
    return regions


def object_figures(
    things: Things, visits: Sequence[Revisit], answers: Sequence[VisitAnswer]
) -> ObjectFigures | None:
    """Compare a method's objects with the truth; None where it tells tiles alone."""
    told = {number: answer.objects for number, answer in enumerate(answers) if answer.objects is not None}
    if len(told) < len(answers):
        return None
    large = [
        (number, thing, is_true(thing, visits[number]))
        for number, objects in told.items()
        for thing in objects
        if len(thing.keys) >= things.min_voxels
    ]
    return ObjectFigures(
        found=np.array([is_found(region, told[region.visit]) for region in things.regions], bool),
        told_moved=np.array(
            [_told_moved(things.regions[a], things.regions[b], told) for a, b in things.moved], bool
        ),
        true=np.array([true for _, _, true in large], bool),
        of_visit=np.array([number for number, _, _ in large], np.int64),
        any_size=np.array([len(told[number]) for number in range(len(answers))], np.int64),
    )


def is_found(region: TrueRegion, objects: Sequence[PredictedObject]) -> bool:
    """Tell whether any object of the right visit covers a quarter of the region."""
    return any(_covers(thing, region) for thing in objects)


def is_true(thing: PredictedObject, revisit: Revisit) -> bool:
    """Tell whether at least half of an object's voxels lie within 2 voxels of a true change, decidable or not."""
    return bool(near(thing.keys, revisit.truth.surface, NEARBY).mean() >= TRUE)


def _covers(thing: PredictedObject, region: TrueRegion) -> bool:
    keys = thing.keys_in(region.side)
    return bool(len(keys)) and bool(near(region.keys, keys, MATCH).mean() >= COVERED)


def _told_moved(first: TrueRegion, second: TrueRegion, told: Mapping[int, Sequence[PredictedObject]]) -> bool:
    objects = [thing for thing in told[first.visit] if thing.kind == "moved"]
    return any(_covers(thing, first) and _covers(thing, second) for thing in objects)


def _gone_or_come(side: Visit) -> str:
    return "gone" if side is Visit.FIRST else "come"


def _share(yes: Bools) -> float | None:
    return round(float(yes.mean()), 4) if len(yes) else None
