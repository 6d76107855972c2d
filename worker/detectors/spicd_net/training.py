"""How SPICD-Net is trained: its batches, and what its T-Nets add to the loss (paper, Sections 3.6 and 3.7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from worker.cloud.patches import Patch
from worker.cloud.types import Points
from worker.detectors.siamese import training as siamese
from worker.detectors.siamese.head import PairHead
from worker.detectors.siamese.layers import PooledLinear
from worker.detectors.siamese.training import SiameseTraining, both_sides, device_of, focal_loss, labels_of
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.network import PairOutput, SpicdNetwork
from worker.detectors.trainable import Pair

ORTHOGONALITY = 0.001


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch(siamese.Batch):
    """B examples as the network takes them."""

    points: Points  #: (P, 3) float32: 2 B clouds end to end, references first, each with its centroid at 0
    sizes: list[int]  #: of the clouds


@dataclass(frozen=True, kw_only=True, slots=True)
class SpicdNetTraining(SiameseTraining[Batch]):
    """TrainableNetwork (worker.detectors.trainable)."""

    title: ClassVar[str] = "SPICD-Net"

    def build(self, *, coarse_search: bool = False) -> SpicdNetwork:
        """Return the network before training; a coarse search is that of PooledLinear."""
        network = SpicdNetwork(counts=self.counts)
        for module in network.modules():
            if isinstance(module, PooledLinear):
                module.coarse_search = coarse_search
        return network

    def collate(self, pairs: Sequence[Pair], rng: np.random.Generator) -> Batch:
        """Put references before currents, every cloud about its centroid."""
        clouds = both_sides(pairs)
        samples = self._samples(clouds, rng)
        return Batch(
            points=np.concatenate([cloud - cloud.mean(axis=0) for cloud in clouds]),
            sizes=[len(cloud) for cloud in clouds],
            chamfer_points=np.concatenate(samples),
            chamfer_sizes=[len(sample) for sample in samples],
            labels=labels_of(pairs),
        )

    def answer(self, module: nn.Module, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return logits (B, 3), and focal loss with the T-Nets' orthogonality."""
        points, samples, labels = (
            torch.from_numpy(array).to(device_of(module))
            for array in (batch.points, batch.chamfer_points, batch.labels)
        )
        output: PairOutput = module(points, batch.sizes, samples, batch.chamfer_sizes)
        return output.logits, total_loss(output.logits, labels, output.transforms)

    def descriptors(self, module: nn.Module, batch: Batch) -> Tensor:
        """Encode the clouds of a batch as a training step does: (2 B, 1024)."""
        points = torch.from_numpy(batch.points).to(device_of(module))
        descriptors: Tensor = _network(module).encoder(points, batch.sizes)[0]
        return descriptors

    def head(self, module: nn.Module) -> PairHead:
        """Return the head of a network that `build` made."""
        return _network(module).head

    def encoder(self, module: nn.Module) -> siamese.Encoder:
        """Return the frozen encoder, which takes a patch's distinct points and its centroid."""
        device, frozen = device_of(module), FrozenEncoder(_network(module).encoder)

        def encode(prepared: Patch) -> Tensor:
            return frozen(
                *(torch.from_numpy(part).to(device) for part in (prepared.distinct, prepared.centroid))
            )

        return encode


def _network(module: nn.Module) -> SpicdNetwork:
    if not isinstance(module, SpicdNetwork):
        raise TypeError(f"SPICD-Net is trained here, not {type(module).__name__}")
    return module


def total_loss(logits: Tensor, labels: Tensor, transforms: tuple[Tensor, ...]) -> Tensor:
    """Return focal loss and the T-Nets' orthogonality, L = L_focal + 0.001 L_ortho."""
    return focal_loss(logits, labels) + ORTHOGONALITY * orthogonality(transforms)


def orthogonality(transforms: tuple[Tensor, ...]) -> Tensor:
    """Return |I - A A'|^2 (Frobenius), averaged over the batch and over the T-Nets' matrices, each (B, k, k)."""
    losses = []
    for matrix in transforms:
        matrix = matrix.float()  # noqa: PLW2901
        identity = torch.eye(matrix.shape[1], device=matrix.device)
        losses.append((identity - matrix @ matrix.transpose(1, 2)).square().sum(dim=(1, 2)).mean())
    return torch.stack(losses).mean()
