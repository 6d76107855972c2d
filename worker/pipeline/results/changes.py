"""Changes: what the scores say of each tile (paper, Section 3.9.4), and what cannot be said."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import TilePairs
from worker.detectors.detector import Detection, change_score


class TileState(IntEnum):
    """What a client is told of a tile; the numbers stand in the coloured cloud."""

    UNCHANGED = 0  #: looked at, and the same
    CHANGED = 1  #: looked at, and different
    INCONSISTENT = 2  #: below the threshold, but "different place" is the likeliest class
    UNOBSERVED = 3  #: not seen densely enough to say

    @property
    def label(self) -> str:
        """The name in the API."""
        return self.name.lower()


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangeSet:
    """One state and one score a tile."""

    pairs: TilePairs
    probabilities: NDArray[np.float32]  #: (T, 3), NaN where unobserved
    states: NDArray[np.uint8]  #: (T,) values of TileState
    threshold: float

    @property
    def scores(self) -> NDArray[np.float32]:
        """(T,) probability that the tile is not as it was, NaN where unobserved."""
        return change_score(self.probabilities)

    def counts(self) -> dict[str, int]:
        """Count the tiles by state, every state named."""
        counts = Counter(int(state) for state in self.states)
        return {state.label: counts[state] for state in TileState}


def decide(pairs: TilePairs, detection: Detection, *, threshold: float) -> ChangeSet:
    """Call a tile changed where its score is above the threshold, and inconsistent where class 2 wins below it.

    The paper only knows the first; a tile that looks like another place is no proof of "no change" either.
    Raises ValueError where an observed tile has no score: that is a fault of the detector, and no state fits it.
    """
    observed = pairs.observed
    unscored = int(np.isnan(detection.probabilities[observed]).any(axis=1).sum())
    if unscored:
        raise ValueError(f"{unscored} of {int(observed.sum())} observed tiles were given NaN by the detector")
    probabilities = np.where(observed[:, None], detection.probabilities, np.float32(np.nan))
    states = np.full(len(probabilities), TileState.UNCHANGED, np.uint8)
    states[np.nan_to_num(probabilities).argmax(axis=1) == 2] = TileState.INCONSISTENT
    states[change_score(probabilities) > threshold] = TileState.CHANGED
    states[~observed] = TileState.UNOBSERVED
    return ChangeSet(pairs=pairs, probabilities=probabilities, states=states, threshold=threshold)
