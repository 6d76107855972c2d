"""The head of a Siamese network: two descriptors and what geometry says of the pair, to three classes."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from worker.detectors.siamese.chamfer import COUNTS, STATISTICS

CHAMFER_FEATURES = 32
CHAMFER_GATING = 0.2
CLASSES = 3


class PairHead(nn.Module):
    """Two descriptors and the statistics of a pair to three logits (paper, Sections 3.6.2 to 3.6.4).

    The paper's statistics are the eight of the Chamfer branch; with `counts` eight of point counts stand beside them.
    """

    def __init__(self, descriptor: int, *, counts: bool = False) -> None:
        super().__init__()
        self.descriptor = descriptor
        self.statistics = STATISTICS + COUNTS * counts
        self.chamfer = nn.Sequential(
            nn.Linear(self.statistics, 64), nn.ReLU(), nn.Linear(64, CHAMFER_FEATURES), nn.ReLU()
        )
        self.classifier = nn.Sequential(
            nn.Linear(2 * descriptor + CHAMFER_FEATURES, 256),
            nn.ReLU(),
            nn.Dropout(0.5),
            nn.Linear(256, 128),
            nn.ReLU(),
            nn.Dropout(0.5),
            nn.Linear(128, CLASSES),
        )

    def forward(self, reference: Tensor, current: Tensor, statistics: Tensor) -> Tensor:
        """(B, D), (B, D), (B, 8 or 16) -> (B, 3) logits"""
        geometry = self.chamfer(statistics)
        if self.training:
            geometry = geometry * (torch.rand(len(geometry), 1, device=geometry.device) >= CHAMFER_GATING)
        logits: Tensor = self.classifier(fused(reference, current, geometry))
        return logits

    @torch.no_grad()
    def initialize_from_data(self, reference: Tensor, current: Tensor, statistics: Tensor) -> None:
        """Initialise from data: both first layers begin as if their inputs were standardised.

        The statistics differ by centimetres and the products are some ten, so that at first the head would
        hear of nothing but the products. Same arguments as `forward`.
        """
        _standardise(self.chamfer[0], statistics, blocks=(self.statistics,))
        inputs = fused(reference, current, self.chamfer(statistics))
        _standardise(self.classifier[0], inputs, blocks=(self.descriptor, self.descriptor, CHAMFER_FEATURES))


def fused(reference: Tensor, current: Tensor, geometry: Tensor) -> Tensor:
    """(B, D), (B, D), (B, 32) -> (B, 2 D + 32)"""
    return torch.cat([(reference - current).abs(), reference * current, geometry], dim=1)


def _standardise(layer: nn.Module, inputs: Tensor, *, blocks: tuple[int, ...]) -> None:
    """Scale and shift a Linear for its inputs (n, C), each block of columns giving the outputs equal variance."""
    if not isinstance(layer, nn.Linear):
        raise TypeError(f"a linear layer is initialised from data, not {type(layer).__name__}")
    std = inputs.std(dim=0)
    std = std.clamp_min(0.1 * float(std[std > 0].median()))  # columns that hardly vary are not blown up
    shares = [torch.full((n,), (inputs.shape[1] / (len(blocks) * n)) ** 0.5) for n in blocks]
    layer.weight.mul_(torch.cat(shares).to(std.device) / std)
    layer.bias.sub_(layer.weight @ inputs.mean(dim=0))
