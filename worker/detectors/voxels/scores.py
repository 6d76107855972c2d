"""From voxels to tiles: a detection made of each direction's probabilities."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from worker.cloud.seen import Seen
from worker.cloud.settings import StrictModel
from worker.cloud.tiling import TileGrid, Tiles
from worker.cloud.types import Arrays, Bools, Floats, Indices
from worker.cloud.voxel_keys import Keys, near, regions, rows_of, union
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection, VoxelScores
from worker.detectors.voxels.evidence import (
    Evidence,
    EvidenceSettings,
    Missing,
    free_space,
    gathered,
    missing,
    passing,
)
from worker.progress import Progress, no_progress

#: Of a region's voxels, that blocked the view of a scan. Measured in simulated offices and rooms: 0.6 (a ladder) to 1.0
#: of what stands, 0.0 to 0.1 of people, up to 0.4 where the region is small.
STANDING_SHARE = 0.45
STANDING_SCANS = 1.5  #: scans of the same visit, in the mean over a region, that confirm what stands
_FEWEST = 10  # voxels of a region of which that can be said
_FRINGE = 2  # voxels around somebody who walked by, which are no more certain than he is
_SPOTS = (4, 4, 3)  # places along x, y, z of a tile that free space is asked at
_SPOT_WEIGHT = 10.0  # voxels of surface that one of them counts as


class TileScoreSettings(StrictModel):
    """How the changed voxels of a tile make its score: sigmoid(slope * log(1 + expected changed voxels) + offset)."""

    slope: float = Field(2.0, gt=0)
    offset: float = -6.0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Answer:
    """One direction's answer."""

    missing: Missing
    keys: Keys  #: (N,) ascending
    probabilities: NDArray[np.float32]  #: (N,) that what own hit there is missing from other
    moving: Bools  #: (N,)


class Scorer:
    """Detector (worker.detectors.detector) by voxels; a rule or a network answers one direction by its evidence."""

    def __init__(self, card: Card, evidence: EvidenceSettings, tiles: TileScoreSettings) -> None:
        self.card = card
        self._evidence, self._tiles = evidence, tiles

    def encode_reference(
        self,
        reference: Side,  # noqa: ARG002
        tiles: Tiles,  # noqa: ARG002
        *,
        progress: Progress = no_progress,
    ) -> Arrays:
        """Return nothing: what the map's scans saw is kept with the map."""
        progress("encoding", 1.0)
        return {}

    def detect(
        self,
        comparison: Comparison,
        *,
        embedding: Arrays | None = None,  # noqa: ARG002
        progress: Progress = no_progress,
    ) -> Detection:
        """Score every voxel and tile. Raises ValueError where a side's `seen` is not there."""
        progress("scoring", 0.0)
        detection = detected(comparison, self, self._evidence, self._tiles)
        progress("scoring", 1.0)
        return detection

    def score(self, evidence: Evidence, *, free_space: bool) -> NDArray[np.float32]:
        """Return (N,) the probability of each voxel that what own hit there is missing from other."""
        raise NotImplementedError


def answered(own: Seen, other: Seen, scorer: Scorer, settings: EvidenceSettings) -> Answer:
    """Ask of what own hit, what is missing from other.

    The gate: a voxel that own did not hit, or that the other visit could not judge, has no probability. What own saw
    through as well, and so is not believed to stand there, moved during the visit; so did a region past which its own
    scans saw what is behind.
    """
    lacks = missing(own, other, settings)
    if not len(lacks.candidates):
        nothing = np.empty(0, np.int64)
        return Answer(missing=lacks, keys=nothing, probabilities=np.empty(0, "f4"), moving=np.empty(0, bool))
    evidence = gathered(own, other, lacks.candidates, settings)
    probabilities = scorer.score(evidence, free_space=free_space(own, other))
    rows = rows_of(evidence.keys, own.keys)
    hit = rows >= 0
    if not settings.gate:
        moving = np.zeros(len(hit), bool)
        ungated = np.where(hit, probabilities, 0).astype(np.float32)
        return Answer(missing=lacks, keys=evidence.keys, probabilities=ungated, moving=moving)
    gated = np.where(hit & lacks.judged[rows], probabilities, 0).astype(np.float32)
    walked = _walked(own, evidence, rows, gated)
    closed = walked | _unproven(own, other, evidence, gated, settings)
    fringe = near(evidence.keys, evidence.keys[closed], _FRINGE) & (gated <= 0.5)
    gated[closed | fringe] = 0
    moving = walked | (passing(evidence) & (gated < 0.5))
    return Answer(missing=lacks, keys=evidence.keys, probabilities=gated, moving=moving)


def _walked(
    own: Seen, evidence: Evidence, rows: NDArray[np.int64], probabilities: NDArray[np.float32]
) -> Bools:
    """Tell (N,) which voxels are of changed regions that stood for no scan of the visit that hit them (`Sights.stands`).

    What several scans confirm stands as well, also where it can be seen through as a plant can. `rows` (N,) are those
    of the voxels in what own saw. Without sights, and of regions of a few voxels, nobody knows.
    """
    answer = np.zeros(len(evidence.keys), bool)
    changed = np.flatnonzero(probabilities > 0.5)
    if own.sights is None or not len(changed):
        return answer
    count, region = regions(evidence.keys[changed])
    size = np.bincount(region, minlength=count)
    stood = np.bincount(region, weights=own.sights.stands(own.points[rows[changed]]), minlength=count) / size
    scans = np.bincount(region, weights=evidence.own.confirmed[changed], minlength=count) / size
    answer[changed] = ((stood < STANDING_SHARE) & (scans < STANDING_SCANS) & (size >= _FEWEST))[region]
    return answer


def _unproven(
    own: Seen,
    other: Seen,
    evidence: Evidence,
    probabilities: NDArray[np.float32],
    settings: EvidenceSettings,
) -> Bools:
    """Tell (N,) which voxels are of changed regions of which hardly any was surely seen through.

    Along a wall that a scan only grazes single directions lie beyond its voxels, but not those around them as well.
    """
    answer = np.zeros(len(evidence.keys), bool)
    changed = np.flatnonzero(probabilities > 0.5)
    if not free_space(own, other) or not len(changed):
        return answer
    count, region = regions(evidence.keys[changed])
    sure = np.bincount(region, weights=evidence.other.surely[changed] > 0, minlength=count)
    answer[changed] = (sure / np.bincount(region, minlength=count) < settings.min_sure_share)[region]
    return answer


def detected(
    comparison: Comparison, scorer: Scorer, evidence: EvidenceSettings, tiles: TileScoreSettings
) -> Detection:
    """Score voxels both ways, and tiles by them. Raises ValueError where a side's `seen` is not there."""
    reference, current = comparison.reference.seen, comparison.current.seen
    if reference is None or current is None:
        raise ValueError("a detector by voxels needs what both visits saw")
    if not free_space(
        reference, current
    ):  # what one visit alone saw through is no evidence, and not learned from
        reference, current = replace(reference, sights=None), replace(current, sights=None)
    with ThreadPoolExecutor(2) as pool:  # NumPy and torch let each other run
        pending = pool.submit(answered, reference, current, scorer, evidence)
        new = answered(current, reference, scorer, evidence)
        gone = pending.result()
    voxels = _voxel_scores(reference, current, gone, new)
    counts, sums = _per_tile(comparison, reference, current, gone, new)
    share = observed_share(comparison.grid, comparison.tiles, reference, current, gone.missing.judged)
    score = tile_score(sums, tiles)
    probabilities = np.stack([1 - score, score, np.zeros_like(score)], axis=1).astype(np.float32)
    probabilities[(share == 0) & (sums == 0)] = np.nan
    return Detection(
        probabilities=probabilities,
        observed_share=share.astype(np.float32),
        appeared=counts[1],
        disappeared=counts[0],
        voxels=voxels,
    )


def tile_score(sums: Floats, settings: TileScoreSettings) -> Floats:
    """Return the probability of change (T,) of tiles with so many changed voxels to be expected (T,)."""
    return np.asarray(1 / (1 + np.exp(-(settings.slope * np.log1p(sums) + settings.offset))))


def observed_share(
    grid: TileGrid, tiles: Indices, reference: Seen, current: Seen, judged: Bools
) -> NDArray[np.float64]:
    """Return (T,) the share of what the map knows of a tile, its surfaces and free space, that the survey could judge.

    `judged` (V,) is of the map's voxels. A tile of which the map knows nothing has 0.
    """
    row = grid.locate_among(reference.points, tiles) + 1
    known = np.bincount(row, minlength=len(tiles) + 1)[1:].astype(np.float64)
    seen = np.bincount(row, weights=judged, minlength=len(tiles) + 1)[1:]
    if free_space(reference, current) and len(tiles):
        steps = [(np.arange(count) + 0.5) / count for count in _SPOTS]
        within = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3) * grid.size
        spots = (grid.lower(tiles)[:, None, :] + within).reshape(-1, 3).astype(np.float32)
        free = reference.verdicts(spots).through > 0
        again = np.zeros(len(spots), bool)
        again[free] = current.verdicts(spots[free]).judged
        known += _SPOT_WEIGHT * free.reshape(len(tiles), -1).sum(axis=1)
        seen += _SPOT_WEIGHT * again.reshape(len(tiles), -1).sum(axis=1)
    return np.asarray(seen / np.maximum(known, 1))


def _voxel_scores(reference: Seen, current: Seen, gone: Answer, new: Answer) -> VoxelScores:
    keys, *places = union(reference.keys, current.keys)
    judged, through = np.zeros(len(keys), bool), np.zeros(len(keys), np.int16)
    scores, moving = [], np.zeros(len(keys), bool)
    for rows, answer in zip(places, (gone, new), strict=True):
        judged[rows] |= answer.missing.judged
        through[rows] = np.maximum(through[rows], answer.missing.seen_through)
        there = np.searchsorted(keys, answer.keys)
        score = np.zeros(len(keys), np.float32)
        score[there] = answer.probabilities
        moving[there] |= answer.moving
        scores.append(score)
    return VoxelScores(
        keys=keys,
        appeared=scores[1],
        disappeared=scores[0],
        judged=judged,
        moving=moving,
        seen_through=through,
    )


def _per_tile(
    comparison: Comparison, reference: Seen, current: Seen, gone: Answer, new: Answer
) -> tuple[list[NDArray[np.int32]], Floats]:
    """Return the voxels that disappeared and appeared in each tile, (T,) each, and how many to expect in all (T,)."""
    count = len(comparison.tiles)
    changed, expected = [], np.zeros(count)
    for seen, answer in ((reference, gone), (current, new)):
        some = answer.probabilities > 0
        points = seen.points[rows_of(answer.keys[some], seen.keys)]
        tile = comparison.grid.locate_among(points, comparison.tiles) + 1
        p = answer.probabilities[some]
        changed.append(np.bincount(tile[p > 0.5], minlength=count + 1)[1:].astype(np.int32))
        expected += np.bincount(tile, weights=p, minlength=count + 1)[1:]
    return changed, expected
