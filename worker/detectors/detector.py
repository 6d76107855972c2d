"""What a detector is: a map and a survey of it in, class probabilities a tile out, and a voxel where it can."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import Tiles
from worker.cloud.types import Arrays, Bools
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison, Side
from worker.progress import Progress, no_progress

Probabilities = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VoxelScores:
    """What is said of each of the V voxels that either visit hit, map frame."""

    keys: NDArray[np.int64]  #: (V,) ascending
    appeared: Probabilities  #: (V,) the survey hit something that was not there; 0 where it hit nothing
    disappeared: Probabilities  #: (V,) what the map has is no longer there; 0 where it has nothing
    judged: Bools  #: (V,) whether the other visit could tell; where it could not, both probabilities are 0
    moving: Bools  #: (V,) whether the very visit that hit it saw through it as well: people, doors
    seen_through: NDArray[np.int16]  #: (V,) scans of the other visit that saw through it


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Detection:
    """Class probabilities of every tile: no change, changed, different place (paper, Section 3.1)."""

    #: (T, 3), rows sum to 1; NaN where the tile was not observed, and so cannot be compared
    probabilities: Probabilities
    observed_share: Probabilities | None = (
        None  #: (T,) of what the map knows of the tile, what could be judged
    )
    appeared: NDArray[np.int32] | None = None  #: (T,) voxels
    disappeared: NDArray[np.int32] | None = None  #: (T,) voxels
    voxels: VoxelScores | None = None  #: None: the detector scores tiles alone

    @classmethod
    def of_scores(cls, scores: NDArray[np.floating]) -> Detection:
        """Take one score a tile (T,), the probability of change, for a method that knows no different place."""
        change = scores.astype(np.float32)
        return cls(probabilities=np.stack([1 - change, change, change * 0], axis=1))

    @property
    def change(self) -> Probabilities:
        """(T,) see `change_score`."""
        return change_score(self.probabilities)


def change_score(probabilities: Probabilities) -> Probabilities:
    """Return the probability that a tile is not as it was, 1 - p0: (T, 3) -> (T,); NaN stays NaN.

    The paper takes class 1 alone (Section 3.9.2). A tile of a registered survey that looks like another place has
    changed altogether, or was registered wrongly: reason enough to look there.
    """
    return 1 - probabilities[:, 0]


class Detector(Protocol):
    """A method of comparing a survey with its map. It prepares its own input and says in its card what it needs.

    A new detector is a folder with one class of this shape and a `load`, one entry in
    `worker.detectors.registry.DETECTORS`, and one folder in `model_store/` with its card.
    """

    card: Card

    def encode_reference(self, reference: Side, tiles: Tiles, *, progress: Progress = no_progress) -> Arrays:
        """Return what can be computed of the map alone, once when it is built; {} if nothing."""

    def detect(
        self, comparison: Comparison, *, embedding: Arrays | None = None, progress: Progress = no_progress
    ) -> Detection:
        """Score every observed tile; `embedding` is what `encode_reference` returned for the map, if it was kept."""
