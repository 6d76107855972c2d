"""Chamfer statistics of a pair (paper, Section 3.6.3)."""

from __future__ import annotations

import torch
from torch import Tensor

SAMPLE_POINTS = 128
STATISTICS = 8


@torch.no_grad()
def chamfer_statistics(reference: Tensor, current: Tensor) -> Tensor:
    """log(1 + x) of mean, maximum, median and 90th percentile of the nearest distances, both ways.

    `reference` and `current` are (B, n, 3), metres, tile-centre frame; the result is (B, 8), the four of
    reference to current first. No gradient passes.
    """
    distances = torch.cdist(reference, current)  # (B, n, n)
    nearest = torch.stack([distances.amin(dim=2), distances.amin(dim=1)], dim=1)  # (B, 2, n)
    quantiles = torch.quantile(nearest, torch.tensor([0.5, 0.9], device=nearest.device), dim=2)  # (2, B, 2)
    statistics = torch.stack([nearest.mean(2), nearest.amax(2), quantiles[0], quantiles[1]], dim=2)
    return torch.log1p(statistics.flatten(1))
