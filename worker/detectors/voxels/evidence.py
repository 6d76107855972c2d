"""Evidence: what both visits tell of the places where one hit something and the other did not.

Asked in one direction at a time: of what `own` hit, what may be missing from `other`? With own the map that is what
disappeared, with own the survey what appeared. Both are one question, so one rule or network answers both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from worker.cloud.seen import Seen
from worker.cloud.settings import StrictModel
from worker.cloud.sight import FARTHEST_RESIDUAL, Verdicts
from worker.cloud.types import Bools, Points
from worker.cloud.voxel_keys import Keys, blocks, dilated, near, regions, rows_of, union

CHANNELS = 12  #: of `Evidence.channels`
_BLOCK = 2  # levels: context is found by blocks of 4 voxels


class EvidenceSettings(StrictModel):
    """Where evidence is gathered."""

    reach: int = Field(1, ge=0, description="voxels; where the other visit hit so near, nothing is missing")
    min_candidates: int = Field(4, ge=1, description="voxels of a region of candidates that is looked into")
    context: int = Field(
        2, ge=0, description="blocks of 4 voxels around a candidate that are looked into as well"
    )
    gate: bool = Field(
        True, description="off, to see what it does: probabilities of voxels that nobody could judge count"
    )
    min_sure_share: float = Field(
        0.1, ge=0, le=1, description="of a changed region's voxels, that the other visit surely saw through"
    )
    near_blocks: int = Field(
        2,
        ge=1,
        description="blocks of 4 voxels; without sights, a visit knows what is so near to what it hit",
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Missing:
    """Which of the V voxels that one visit hit may be missing from the other."""

    judged: Bools  #: (V,) whether the other visit could tell
    seen_through: NDArray[np.int16]  #: (V,) scans of the other visit that saw through the voxel
    candidates: Keys  #: (C,) voxels that the other visit did not hit, but could judge; ascending


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Evidence:
    """What is known of N voxels, hit by either visit, around the candidates."""

    keys: Keys  #: (N,) ascending
    own_hits: NDArray[np.int32]  #: (N,)
    other_hits: NDArray[np.int32]  #: (N,)
    own: Verdicts  #: of N places, by the visit that may have hit something that is missing
    other: Verdicts  #: of N places, by the visit that it may be missing from
    candidate: Bools  #: (N,)

    @property
    def channels(self) -> NDArray[np.float32]:
        """(N, 12): hits and verdicts of own and other as logarithms of 1 + counts, residuals from 0 to 1."""
        columns: list[NDArray[np.integer[Any]]] = [self.own_hits, self.other_hits]
        for verdicts in (self.other, self.own):
            columns += [verdicts.through, verdicts.surely, verdicts.confirmed, verdicts.hidden]
        counts = np.log1p(np.stack(columns, axis=1).astype(np.float32))
        residuals = np.stack([self.other.residual, self.own.residual], axis=1) / np.float32(FARTHEST_RESIDUAL)
        return np.concatenate([counts, residuals], axis=1)


def free_space(one: Seen, other: Seen) -> bool:
    """Tell whether both visits know what they saw through."""
    return one.sights is not None and other.sights is not None


def missing(own: Seen, other: Seen, settings: EvidenceSettings) -> Missing:
    """Look for what `own` hit and `other` did not, although it looked there.

    Where either has no sights, a place counts as looked at if the other visit hit something near to it.
    """
    matched = near(own.keys, other.keys, settings.reach)
    lonely = np.flatnonzero(~matched)
    judged, through = matched.copy(), np.zeros(len(own.keys), np.int16)
    if free_space(own, other):
        verdicts = other.verdicts(own.points[lonely])
        judged[lonely] = verdicts.judged
        through[lonely] = verdicts.through
        chosen = lonely[verdicts.through > 0]
    else:
        around = np.unique(blocks(other.keys, _BLOCK))
        known = near(blocks(own.keys[lonely], _BLOCK), around, settings.near_blocks)
        judged[lonely] = known
        chosen = lonely[known]
    candidates = own.keys[chosen]
    return Missing(
        judged=judged, seen_through=through, candidates=_large(candidates, settings.min_candidates)
    )


def gathered(own: Seen, other: Seen, candidates: Keys, settings: EvidenceSettings) -> Evidence:
    """Gather the evidence at and around the candidates (C,), ascending."""
    around = dilated(blocks(candidates, _BLOCK), settings.context)
    own_rows, other_rows = _rows_in(own.keys, around), _rows_in(other.keys, around)
    keys, *places = union(own.keys[own_rows], other.keys[other_rows])
    hits, sums = [], np.zeros((len(keys), 3))
    for seen, rows, place in ((own, own_rows, places[0]), (other, other_rows, places[1])):
        count = np.zeros(len(keys), np.int32)
        count[place] = seen.hits[rows]
        sums[place] += seen.points[rows].astype(np.float64) * seen.hits[rows, None]
        hits.append(count)
    points: Points = (sums / np.maximum(hits[0] + hits[1], 1)[:, None]).astype(np.float32)
    return Evidence(
        keys=keys,
        own_hits=hits[0],
        other_hits=hits[1],
        own=own.verdicts(points),
        other=other.verdicts(points),
        candidate=rows_of(keys, candidates) >= 0,
    )


def passing(evidence: Evidence) -> Bools:
    """Tell (N,) which candidates the very visit that hit them saw through as often as it confirmed them.

    So looks what moved during the visit: a person, a door.
    """
    answer: Bools = (
        evidence.candidate & (evidence.own.surely > 0) & (evidence.own.surely >= evidence.own.confirmed)
    )
    return answer


def _large(keys: Keys, fewest: int) -> Keys:
    """Keep the voxels of connected regions of at least `fewest`."""
    count, region = regions(keys)
    return keys[np.bincount(region, minlength=count)[region] >= fewest] if count else keys


def _rows_in(keys: Keys, around: Keys) -> NDArray[np.intp]:
    """Return the rows of the voxels (V,) that lie in these blocks, ascending."""
    return np.flatnonzero(rows_of(blocks(keys, _BLOCK), around) >= 0)
