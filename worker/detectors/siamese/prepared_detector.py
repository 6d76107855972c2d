"""A Siamese network whose clouds are prepared, as a detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from worker.cloud.patches import Patch
from worker.detectors.card import Card
from worker.detectors.siamese.detector import SiameseDetector
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

    @torch.inference_mode()
    def _descriptors(self, patches: Sequence[Patch]) -> Tensor:
        """Encode tile by tile on a CPU, where one fills its caches, and all at once on a GPU."""
        few = 1 if self._device.type == "cpu" else len(patches)
        clouds = [patch.distinct for patch in patches]
        starts = range(0, len(clouds), few)
        return torch.cat([self._encoder(self._encoder.prepare(clouds[at : at + few])) for at in starts])
