"""The rule: what one visit hit and the other saw through, in connected regions, has changed. Nothing is trained."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from worker.cloud.settings import StrictModel
from worker.cloud.voxel_keys import regions
from worker.detectors.card import Card
from worker.detectors.voxels.evidence import Evidence, EvidenceSettings, passing
from worker.detectors.voxels.scores import Scorer, TileScoreSettings


class VoxelRuleSettings(StrictModel):
    """`detector_settings` of a card of this detector."""

    min_region: int = Field(10, ge=1, description="voxels; smaller regions are noise")
    min_sure_share: float = Field(
        0.3, ge=0, le=1, description="of a region's voxels, those that a scan surely saw through"
    )
    evidence: EvidenceSettings = EvidenceSettings.model_validate({})
    tiles: TileScoreSettings = TileScoreSettings.model_validate({})


class VoxelRule(Scorer):
    """Detector (worker.detectors.detector) whose every decision can be followed by hand.

    A candidate is a voxel that one visit hit, where the other hit nothing within a voxel and saw through, and
    which the first did not see through itself, as it does with people. A region of at least `min_region` candidates has changed where scans surely saw through enough of it. The probability of its
    voxels is the share of scans that saw through, of all that could tell.
    """

    settings_class = VoxelRuleSettings

    def __init__(self, card: Card) -> None:
        self._settings = card.settings_as(VoxelRuleSettings)
        super().__init__(card, self._settings.evidence, self._settings.tiles)

    @classmethod
    def load(cls, card: Card, weights: Mapping[str, object], device: object) -> VoxelRule:  # noqa: ARG003
        """Open a model; it has no weights and runs on the CPU. Raises ValueError for unsound settings."""
        return cls(card)

    def score(self, evidence: Evidence, *, free_space: bool) -> NDArray[np.float32]:
        """Return (N,) the share of scans that saw through each voxel of a region that is large and sure enough.

        Without free space there is no proof that anything is missing, and the rule says nothing: all 0.
        """
        answer = np.zeros(len(evidence.keys), np.float32)
        rows = np.flatnonzero(evidence.candidate & ~passing(evidence))
        count, region = regions(evidence.keys[rows])
        if not free_space or not count:
            return answer
        size = np.bincount(region, minlength=count)
        sure = np.bincount(region, weights=evidence.other.surely[rows] > 0, minlength=count) / size
        kept = ((size >= self._settings.min_region) & (sure >= self._settings.min_sure_share))[region]
        through = evidence.other.through[rows].astype(np.float32)
        told = through + evidence.other.confirmed[rows]
        answer[rows] = np.where(kept, through / np.maximum(told, 1), 0)
        return answer
