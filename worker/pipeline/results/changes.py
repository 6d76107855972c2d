"""Changes: what the scores say of each tile (paper, Section 3.9.4), and what cannot be said."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import TilePairs, tile_id
from worker.cloud.types import Bools, Indices
from worker.detectors.detector import Detection, VoxelScores, change_score
from worker.pipeline.results.objects import ChangeObjects


class TileState(IntEnum):
    """What a client is told of a tile; the numbers stand in the coloured cloud."""

    UNCHANGED = 0  #: looked at, and the same
    CHANGED = 1  #: looked at, and different
    INCONSISTENT = 2  #: looked at, but maybe another place: of this tile, or of the whole survey
    UNOBSERVED = 3  #: not seen well enough to say

    @property
    def label(self) -> str:
        """The name in the API."""
        return self.name.lower()


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangeSet:
    """What a survey found: one state and one score a tile, and objects where the detector scores voxels."""

    pairs: TilePairs
    probabilities: NDArray[np.float32]  #: (T, 3), NaN where nothing could be compared
    states: NDArray[np.uint8]  #: (T,) values of TileState
    threshold: float
    #: (T,) of what the map knows of the tile, what the survey could judge; None: the detector scores tiles alone
    observed_share: NDArray[np.float32] | None = None
    appeared: NDArray[np.int32] | None = None  #: (T,) voxels; None as above
    disappeared: NDArray[np.int32] | None = None  #: (T,) likewise
    voxels: VoxelScores | None = None  #: as above
    objects: ChangeObjects | None = None  #: as above
    doubtful_placement: float | None = None  #: 0..1, its confidence; None: the placement is not in doubt

    @property
    def scores(self) -> NDArray[np.float32]:
        """(T,) probability that the tile is not as it was, NaN where nothing could be compared."""
        return change_score(self.probabilities)

    def where_objects_lie(self, min_observed_share: float) -> ChangeSet:
        """Return the same, but tiles whose changed voxels are too few or too weak for any object are not changed.

        An object is what the map's own scans say is no false alarm; a tile should raise none either.
        """
        if self.objects is None:
            return self
        touched = {index for thing in self.objects.objects for place in thing.places for index in place.tiles}
        alone = np.array([tile_id(index) not in touched for index in self.pairs.reference.indices], bool)
        states = self.states.copy()
        weak = alone & (states == TileState.CHANGED)
        states[weak] = TileState.UNCHANGED
        if self.observed_share is not None:
            states[weak & (self.observed_share < min_observed_share)] = TileState.UNOBSERVED
        return replace(self, states=states)

    def in_doubt(self, confidence: float) -> ChangeSet:
        """Return what is left to say where the placement of the survey is in doubt, of this confidence (0..1).

        Every tile that was looked at is inconsistent, whatever a detector makes of it: it may be another place. There
        are no objects.
        """
        states = self.states.copy()
        states[states != TileState.UNOBSERVED] = TileState.INCONSISTENT
        return replace(self, states=states, voxels=None, objects=None, doubtful_placement=confidence)

    def with_displaced(self, displaced: Indices) -> ChangeSet:
        """Call tiles (D, 3) inconsistent in which the building itself is off; objects that lie in such alone go."""
        if not len(displaced):
            return self
        ids = {tile_id(index) for index in displaced}
        inside = np.array([tile_id(index) in ids for index in self.pairs.reference.indices], bool)
        states = self.states.copy()
        states[inside & (states != TileState.UNOBSERVED)] = TileState.INCONSISTENT
        objects = None if self.objects is None else self.objects.outside(ids)
        return replace(self, states=states, objects=objects)

    def counts(self) -> dict[str, int]:
        """Count the tiles by state, every state named."""
        counts = Counter(int(state) for state in self.states)
        return {state.label: counts[state] for state in TileState}


def decide(
    pairs: TilePairs, detection: Detection, *, threshold: float, min_observed_share: float = 0.5
) -> ChangeSet:
    """Call a tile changed where its score is above the threshold, and say where it was not seen well enough.

    A detector of voxels tells what of each tile could be judged: a tile that did not change is unobserved where that
    is less than `min_observed_share`, and has its probabilities where it is more than nothing. Of any other detector
    what it says of tiles with too few points is dropped, and where class 2 wins below the threshold the tile is
    inconsistent: the paper knows no such state, but a tile that looks like another place is no proof of "no change".
    Raises ValueError where a tile that could be judged has no score: a fault of the detector, and no state fits it.
    """
    if detection.observed_share is None:
        return _decided_by_points(pairs, detection, threshold)
    share = detection.observed_share
    _check_scored(detection.probabilities, share > 0)
    scores = change_score(detection.probabilities)
    states = np.full(len(scores), TileState.UNCHANGED, np.uint8)
    states[(share < min_observed_share) | np.isnan(scores)] = TileState.UNOBSERVED
    states[scores > threshold] = TileState.CHANGED
    return ChangeSet(
        pairs=pairs,
        probabilities=detection.probabilities,
        states=states,
        threshold=threshold,
        observed_share=share,
        appeared=detection.appeared,
        disappeared=detection.disappeared,
    )


def _decided_by_points(pairs: TilePairs, detection: Detection, threshold: float) -> ChangeSet:
    observed = pairs.observed
    _check_scored(detection.probabilities, observed)
    probabilities = np.where(observed[:, None], detection.probabilities, np.float32(np.nan))
    states = np.full(len(probabilities), TileState.UNCHANGED, np.uint8)
    states[np.nan_to_num(probabilities).argmax(axis=1) == 2] = TileState.INCONSISTENT
    states[change_score(probabilities) > threshold] = TileState.CHANGED
    states[~observed] = TileState.UNOBSERVED
    return ChangeSet(pairs=pairs, probabilities=probabilities, states=states, threshold=threshold)


def _check_scored(probabilities: NDArray[np.float32], observed: Bools) -> None:
    unscored = int(np.isnan(probabilities[observed]).any(axis=1).sum())
    if unscored:
        raise ValueError(f"{unscored} of {int(observed.sum())} observed tiles were given NaN by the detector")
