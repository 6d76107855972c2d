"""SPICD-Net as a detector: what it adds to a Siamese network is its encoder, folded once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar

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

    precisions: ClassVar[tuple[Precision, ...]] = ("float32", "bfloat16")

    def __init__(self, card: Card, network: SpicdNetwork, device: torch.device) -> None:
        super().__init__(card, network, network.head, device)
        self._spicd = network
        self._encode_with("float32", at_once=device.type == "cuda")

    @classmethod
    def load(cls, card: Card, weights: dict[str, Tensor], device: torch.device) -> SpicdNet:
        """Open a model. Raises RuntimeError for weights of another network, ValueError for unsound settings."""
        network = SpicdNetwork(counts=card.settings_as(SiameseSettings).counts)
        network.load_state_dict(weights)
        return cls(card, network, device)

    def _encode_with(self, precision: Precision, *, at_once: bool) -> None:
        """Take the encoder of a processor, which in place of bfloat16 searches in 8 bits, or that of a GPU."""
        super()._encode_with(precision, at_once=at_once)
        searched = precision == "bfloat16" and self._device.type == "cpu"
        self._encoder: FrozenEncoder | TogetherEncoder = (
            TogetherEncoder(self._spicd.encoder, precision).to(self._device)
            if at_once
            else FrozenEncoder(self._spicd.encoder, searched=searched)
        )

    def held_tensors(self) -> Iterator[Tensor]:
        """Yield all that is kept on the device, some perhaps twice."""
        yield from super().held_tensors()
        if isinstance(self._encoder, FrozenEncoder):
            yield from self._encoder.tensors()
        else:
            yield from self._encoder.state_dict().values()

    @torch.inference_mode()
    def _descriptors(self, patches: Sequence[Patch]) -> Tensor:
        clouds = [torch.from_numpy(patch.distinct) for patch in patches]
        centroids = [torch.from_numpy(patch.centroid) for patch in patches]
        if isinstance(self._encoder, FrozenEncoder):
            return self._encoder.encode(
                [cloud.to(self._device) for cloud in clouds],
                [centroid.to(self._device) for centroid in centroids],
            )
        batch = level(clouds).to(self._device)  # one copy to the GPU, and not one a tile
        descriptors: Tensor = self._encoder(batch, torch.stack(centroids).to(self._device))
        return descriptors
