"""SPICD-Net as a detector: what it adds to a Siamese network is its encoder, folded once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from worker.cloud.patches import Patch
from worker.detectors.card import Card
from worker.detectors.precision import Precision
from worker.detectors.siamese.detector import SiameseDetector, SiameseSettings
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.spicd_net.together import TogetherEncoder, level


class SpicdNet(SiameseDetector):
    """Detector (worker.detectors.detector) around the network of the paper's Section 3.6."""

    def __init__(self, card: Card, network: SpicdNetwork, device: torch.device) -> None:
        super().__init__(card, network, network.head, device)
        self._spicd = network
        self._encoder = FrozenEncoder(network.encoder)
        self._at_once: TogetherEncoder | None = None  #: on a GPU, which encodes a batch as one
        self._use_precision("float32")

    @classmethod
    def load(cls, card: Card, weights: dict[str, Tensor], device: torch.device) -> SpicdNet:
        """Open a model. Raises RuntimeError for weights of another network, ValueError for unsound settings."""
        network = SpicdNetwork(counts=card.settings_as(SiameseSettings).counts)
        network.load_state_dict(weights)
        return cls(card, network, device)

    def _use_precision(self, precision: Precision) -> None:
        super()._use_precision(precision)
        if self._device.type != "cpu":
            self._encode_at_once(precision)

    def _encode_at_once(self, precision: Precision) -> None:
        self._at_once = TogetherEncoder(self._spicd.encoder, precision).to(self._device)

    @torch.inference_mode()
    def _descriptors(self, patches: Sequence[Patch]) -> Tensor:
        if self._at_once is not None:
            clouds, centroids = zip(*map(self._on_device, patches), strict=True)
            descriptors: Tensor = self._at_once(level(clouds), torch.stack(centroids))
            return descriptors
        return torch.stack([self._encoder(*self._on_device(patch)) for patch in patches])

    def _on_device(self, patch: Patch) -> tuple[Tensor, Tensor]:
        distinct, centroid = (
            torch.from_numpy(part).to(self._device) for part in (patch.distinct, patch.centroid)
        )
        return distinct, centroid
