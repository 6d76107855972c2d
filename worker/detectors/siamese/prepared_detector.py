"""A Siamese network whose clouds are prepared, as a detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from worker.cloud.patches import Patch
from worker.detectors.card import Card
from worker.detectors.siamese.detector import SiameseDetector
from worker.detectors.siamese.parallel import in_groups
from worker.detectors.siamese.prepared import PreparedEncoder, SiameseNetwork


class PreparedDetector(SiameseDetector):
    """Detector whose encoder takes clouds that NumPy prepared (worker.detectors.siamese.prepared)."""

    encoder_class: ClassVar[type[PreparedEncoder[Any]]]

    def __init__(self, card: Card, network: SiameseNetwork[Any], device: torch.device) -> None:
        super().__init__(card, network, network.head, device)
        self._encoder = network.encoder

    @classmethod
    def load(cls, card: Card, weights: dict[str, Tensor], device: torch.device) -> Self:
        """Open a model. Raises RuntimeError for weights of another network, ValueError for unsound settings."""
        network: SiameseNetwork[Any] = SiameseNetwork(
            cls.encoder_class(), counts=card.settings_as(cls.settings_class).counts
        )
        network.load_state_dict(weights)
        return cls(card, network, device)

    def _descriptors(self, patches: Sequence[Patch]) -> Tensor:
        """Encode tile by tile on a CPU, where one fills its caches, shared among threads; all at once on a GPU."""
        if self._device.type == "cpu":
            return torch.cat(in_groups(self._one_by_one, patches))
        return self._together(patches)

    def _one_by_one(self, patches: Sequence[Patch]) -> Tensor:
        return torch.cat([self._together([patch]) for patch in patches])

    @torch.inference_mode()
    def _together(self, patches: Sequence[Patch]) -> Tensor:
        descriptors: Tensor = self._encoder(self._encoder.prepare([patch.distinct for patch in patches]))
        return descriptors
