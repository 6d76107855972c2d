"""Measures: which things that were put into real visits a model found, and what else it says beyond the real pair's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.benchmarks.real.answers import Answer, FoundObject, scores_at, tiles_of
from worker.benchmarks.real.edits import SIDES, VOXEL, EditedVisits, Side, TrueRegion
from worker.cloud.types import Bools, Floats, Indices
from worker.cloud.voxel_keys import Keys, centers, near, packed
from worker.metrics import Confusion, confusion, pooled

MIN_VOXELS = 40  #: decidable voxels of a thing that is to be found, and voxels of an object that is counted
COVERED = 0.25  #: share of a thing's voxels that one object has to cover
TRUE = 0.5  #: share of an object's voxels that has to lie by a thing that was put in
KNOWN = (
    0.5  #: share of an object's voxels that has to lie by what the unedited pair gave, not to count as new
)
MATCH, NEARBY = 1, 2  #: voxels
CHANGED_TILE = 40  #: decidable voxels of a tile that is changed; with fewer it is not counted

#: Boxes (low, high), metres, frame of the place, in which the real visits themselves differ (docs/real-scans.md): a
#: chair that was pushed aside. Tiles that touch them are not counted.
REAL_CHANGES: dict[str, tuple[tuple[Floats, Floats], ...]] = {
    "room_scan": ((np.array([1.8, -1.7, -1.1]), np.array([2.8, -0.3, -0.3])),),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class PairCounts:
    """What a model made of one edited pair."""

    place: str
    side: Side
    kinds: tuple[str, ...]  #: of the things that were to be found
    found: tuple[bool, ...]  #: of them
    true_objects: int | None  #: of at least 40 voxels, by a thing that was put in; None: no objects at all
    false_objects: int | None  #: of at least 40 voxels, by none, and not in the unedited pair's answer either
    false_of_any_size: int | None  #: likewise, of at least 20
    tiles: Confusion


def counts_of(edited: EditedVisits, answer: Answer, plain: Answer) -> PairCounts:
    """Compare the answer to edited visits with the truth, and with the answer to the visits as they are."""
    sought = [region for region in edited.regions if len(region.decidable) >= MIN_VOXELS]
    objects = answer.objects or ()
    false = [
        thing
        for thing in objects
        if not _is_true(thing, edited.regions) and not _is_known(thing, plain.objects or ())
    ]
    tells = answer.objects is not None
    large = [thing for thing in objects if thing.voxels >= MIN_VOXELS]
    return PairCounts(
        place=edited.visits.place,
        side=edited.regions[0].side if edited.regions else "second",
        kinds=tuple(region.kind for region in sought),
        found=tuple(_is_found(region, objects) for region in sought),
        true_objects=sum(_is_true(thing, edited.regions) for thing in large) if tells else None,
        false_objects=sum(thing.voxels >= MIN_VOXELS for thing in false) if tells else None,
        false_of_any_size=len(false) if tells else None,
        tiles=_tiles(edited, answer),
    )


def _voxels(thing: FoundObject, side: Side) -> Keys:
    return thing.before if side == "first" else thing.now


def _is_found(region: TrueRegion, objects: Sequence[FoundObject]) -> bool:
    """Tell whether any object of the right visit covers a quarter of the thing."""
    keys = [_voxels(thing, region.side) for thing in objects]
    return any(bool(near(region.decidable, one, MATCH).mean() >= COVERED) for one in keys if len(one))


def _is_true(thing: FoundObject, regions: Sequence[TrueRegion]) -> bool:
    """Tell whether at least half of an object's voxels lie within 2 voxels of something that was put in."""
    by = 0
    for side in SIDES:
        hits = [region.hit for region in regions if region.side == side]
        keys = thing.before if side == "first" else thing.now
        if hits and len(keys):
            by += int(near(keys, np.unique(np.concatenate(hits)), NEARBY).sum())
    return by >= TRUE * thing.voxels


def _is_known(thing: FoundObject, plain: Sequence[FoundObject]) -> bool:
    """Tell whether half of an object's voxels lie within 2 voxels of objects in the same visit of the unedited pair."""
    by = 0
    for own, others in (
        (thing.before, [one.before for one in plain]),
        (thing.now, [one.now for one in plain]),
    ):
        there = np.unique(np.concatenate([np.empty(0, np.int64), *others]))
        if len(own) and len(there):
            by += int(near(own, there, NEARBY).sum())
    return by >= KNOWN * thing.voxels


def _tiles(edited: EditedVisits, answer: Answer) -> Confusion:
    """Count all tiles that either visit touched but those with a real change, or too little of one."""
    grid = answer.grid
    points = np.concatenate([scan.points for scan in (*edited.visits.first, *edited.visits.second)])
    tiles = np.unique(tiles_of(points.astype(np.float64), grid), axis=0)
    decidable = _per_tile(tiles, answer, [region.decidable for region in edited.regions])
    any_hit = _per_tile(tiles, answer, [region.hit for region in edited.regions])
    changed = decidable >= CHANGED_TILE
    counted = (changed | (any_hit == 0)) & ~_by_real_change(tiles, answer, edited.visits.place)
    scores = scores_at(answer, tiles)
    return confusion(scores[counted], changed[counted], answer.threshold)


def _per_tile(tiles: Indices, answer: Answer, keys: Sequence[Keys]) -> NDArray[np.int64]:
    """Return (T,) how many of the voxels lie in each of the tiles (T, 3)."""
    every = np.unique(np.concatenate([np.empty(0, np.int64), *keys]))
    cells = packed(tiles)
    order = np.argsort(cells)
    mine = packed(tiles_of(centers(every, VOXEL), answer.grid))
    place = np.searchsorted(cells[order], mine).clip(max=len(cells) - 1)
    there = cells[order][place] == mine
    counts: NDArray[np.int64] = np.bincount(order[place[there]], minlength=len(tiles))
    return counts


def _by_real_change(tiles: Indices, answer: Answer, place: str) -> Bools:
    """Tell (T,) which tiles (T, 3) touch a place where the real visits differ."""
    touched = np.zeros(len(tiles), bool)
    lower = answer.grid.lower(tiles)
    for low, high in REAL_CHANGES.get(place, ()):
        touched |= ((lower < high) & (lower + answer.grid.size > low)).all(axis=1)
    return touched


@dataclass(frozen=True, kw_only=True, slots=True)
class Figures:
    """A model's figures over edited pairs."""

    pairs: int
    sought: int
    found: int | None  #: None: it tells tiles alone
    true_objects: int | None
    false_objects: int | None
    false_of_any_size: int | None
    tiles: Confusion = field(default_factory=Confusion)

    @classmethod
    def of(cls, counts: Sequence[PairCounts]) -> Figures:
        """Add up the counts of pairs."""
        tells = all(one.true_objects is not None for one in counts)
        return cls(
            pairs=len(counts),
            sought=sum(len(one.found) for one in counts),
            found=sum(sum(one.found) for one in counts) if tells else None,
            true_objects=_sum(one.true_objects for one in counts),
            false_objects=_sum(one.false_objects for one in counts),
            false_of_any_size=_sum(one.false_of_any_size for one in counts),
            tiles=pooled(one.tiles for one in counts),
        )

    def document(self) -> Document:
        """Return it as JSON."""
        told = (self.true_objects or 0) + (self.false_objects or 0)
        return {
            "pairs": self.pairs,
            "things": self.sought,
            "found": self.found,
            "recall": None if self.found is None or not self.sought else self.found / self.sought,
            "objects": None if self.found is None else told,
            "precision": (self.true_objects or 0) / told if self.found is not None and told else None,
            "false_objects_a_pair": _ratio(self.false_objects, self.pairs),
            "false_objects_of_any_size_a_pair": _ratio(self.false_of_any_size, self.pairs),
            "tiles": self.tiles.figures(),
        }


def groups_of(counts: Sequence[PairCounts]) -> dict[str, dict[str, tuple[int, int]]]:
    """Return how many things were found, of how many, by place, by visit and by kind."""
    groups: dict[str, dict[str, tuple[int, int]]] = {"place": {}, "visit": {}, "kind": {}}
    for one in counts:
        side = "disappeared" if one.side == "first" else "appeared"
        for kind, found in zip(one.kinds, one.found, strict=True):
            for by, name in (("place", one.place), ("visit", side), ("kind", kind)):
                yes, of = groups[by].get(name, (0, 0))
                groups[by][name] = (yes + found, of + 1)
    return groups


def _sum(values: Iterable[int | None]) -> int | None:
    known = list(values)
    return None if any(value is None for value in known) else sum(value or 0 for value in known)


def _ratio(part: int | None, whole: int) -> float | None:
    return None if part is None or not whole else part / whole
