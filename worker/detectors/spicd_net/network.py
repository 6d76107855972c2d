"""The network of the paper's Section 3.6, as pure modules.

The paper names PointNet (its [9]) for the encoder and says nothing of batch normalisation. As in PointNet,
every layer of the encoder and the T-Nets is normalised but a T-Net's last; the head, which the paper spells out
layer by layer, is not.

Clouds lie end to end: (P, C) holds B of them, with their sizes beside. A max-pool cannot see a repeated point,
so a patch comes in as its distinct points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from worker.detectors.siamese.chamfer import chamfer_statistics
from worker.detectors.siamese.head import PairHead
from worker.detectors.siamese.layers import NormedLinear, PooledLinear

DESCRIPTOR = 1024


@dataclass(frozen=True, slots=True)
class PairOutput:
    """What one forward pass over B pairs gives."""

    logits: Tensor  #: (B, 3)
    transforms: tuple[Tensor, ...]  #: the T-Nets' matrices, (B, 3, 3) and (B, 64, 64), reference then current


class TransformNet(nn.Module):
    """T-Net: a k x k matrix from the points themselves, the identity before training."""

    def __init__(self, k: int) -> None:
        super().__init__()
        self.k = k
        self.points1 = NormedLinear(k, 64)
        self.points2 = NormedLinear(64, 128)
        self.pooled = PooledLinear(128, 1024)
        self.global1 = NormedLinear(1024, 512)
        self.global2 = NormedLinear(512, 256)
        self.matrix = nn.Linear(256, k * k)
        nn.init.zeros_(self.matrix.weight)
        with torch.no_grad():
            self.matrix.bias.copy_(torch.eye(k).flatten())

    def forward(self, x: Tensor, sizes: list[int]) -> Tensor:
        """(P, k) -> (B, k, k)"""
        features = functional.relu(self.points2(functional.relu(self.points1(x))))
        return self.from_pooled(functional.relu(self.pooled(features, sizes)))

    def from_pooled(self, pooled: Tensor) -> Tensor:
        """(B, 1024), rectified -> (B, k, k)"""
        hidden = functional.relu(self.global2(functional.relu(self.global1(pooled))))
        matrix: Tensor = self.matrix(hidden)
        return matrix.view(-1, self.k, self.k)


class PointEncoder(nn.Module):
    """Points to an order-free descriptor (paper, Section 3.6.1)."""

    def __init__(self) -> None:
        super().__init__()
        self.input_transform = TransformNet(3)
        self.mlp1 = NormedLinear(3, 64)
        self.mlp2 = NormedLinear(64, 64)
        self.feature_transform = TransformNet(64)
        self.mlp3 = NormedLinear(64, 128)
        self.mlp4 = PooledLinear(128, DESCRIPTOR)

    def forward(self, points: Tensor, sizes: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Return (P, 3) metres, centroid at 0 -> descriptor (B, 1024), transforms (B, 3, 3) and (B, 64, 64)"""
        a3 = self.input_transform(points, sizes)
        features = functional.relu(self.mlp2(functional.relu(self.mlp1(transformed(points, a3, sizes)))))
        a64 = self.feature_transform(features, sizes)
        features = functional.relu(self.mlp3(transformed(features, a64, sizes)))
        return self.mlp4(features, sizes), a3, a64


class SpicdNetwork(nn.Module):
    """Shared encoder, fusion and head; with `counts` the head is given those of `chamfer.py` too."""

    def __init__(self, *, counts: bool = False) -> None:
        super().__init__()
        self.counts = counts
        self.encoder = PointEncoder()
        self.head = PairHead(DESCRIPTOR, counts=counts)

    def forward(
        self, points: Tensor, sizes: list[int], chamfer_points: Tensor, chamfer_sizes: list[int]
    ) -> PairOutput:
        """Classify B pairs, given as 2 B clouds of `sizes`, the references before the currents.

        `points` is (P, 3) metres with each cloud's centroid at 0. What the Chamfer branch compares is (Q, 3) metres,
        tile-centre frame, as many clouds of `chamfer_sizes` in the same order. Both branches are one batch: the same
        weights, and the same statistics to normalise by.
        """
        descriptors, a3, a64 = self.encoder(points, sizes)
        f_ref, f_cur = descriptors.chunk(2)
        compared = torch.split(chamfer_points, chamfer_sizes)
        half = len(compared) // 2
        statistics = chamfer_statistics(compared[:half], compared[half:], counts=self.counts)
        logits = self.head(f_ref, f_cur, statistics)
        return PairOutput(logits, (*a3.chunk(2), *a64.chunk(2)))


def transformed(x: Tensor, matrices: Tensor, sizes: list[int]) -> Tensor:
    """Return (P, k) and a matrix (B, k, k) for each cloud -> (P, k)"""
    return torch.cat([cloud @ matrix for cloud, matrix in zip(torch.split(x, sizes), matrices, strict=True)])
