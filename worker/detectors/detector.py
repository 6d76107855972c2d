"""What a detector is: paired tiles in, three class probabilities a tile out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays
from worker.detectors.card import Card
from worker.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True, slots=True)
class TileScores:
    """Class probabilities of every tile: no change, changed, different place (paper, Section 3.1)."""

    probabilities: NDArray[np.float32]  #: (T, 3), rows sum to 1; NaN where the tile was not observed

    @property
    def change(self) -> NDArray[np.float32]:
        """(T,) see `change_score`."""
        return change_score(self.probabilities)


def change_score(probabilities: NDArray[np.float32]) -> NDArray[np.float32]:
    """(T, 3) -> (T,) probability that the tile is not as it was, 1 - p0; NaN stays NaN.

    The paper takes class 1 alone (Section 3.9.2). A tile of a registered survey that looks like another place has
    changed altogether, or was registered wrongly: reason enough to look there.
    """
    return 1 - probabilities[:, 0]


class Detector(Protocol):
    """A method of comparing tiles. It prepares its own input and says in its card what it needs.

    A new detector is one class with this shape, one entry in `worker.detectors.store.DETECTORS`, and one
    folder in `model_store/` with its card.
    """

    card: Card

    def describe(self, tiles: Tiles, *, progress: Progress = no_progress) -> Arrays:
        """What can be known of the reference alone, computed once when the map is built; {} if nothing."""
        ...

    def score(
        self, pairs: TilePairs, *, description: Arrays | None = None, progress: Progress = no_progress
    ) -> TileScores:
        """Compare every observed pair; `description` is `describe(pairs.reference)` from the map, if kept."""
        ...
