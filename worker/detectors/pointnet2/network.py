"""The encoder of PointNet++ with single-scale grouping (Qi et al. 2017, Appendix B.1).

The levels are the second and third of the authors' network for indoor scenes, which sees cubes of 1.5 m and has its
radii in metres. Their first, of 0.1 m, would find a dozen points in a map at 5 cm. The end is that of their
classification: one abstraction over all that is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from worker.cloud.types import Points
from worker.detectors.pointnet2.grouping import GroupedClouds, Level, grouped
from worker.detectors.siamese.layers import NormedLinear
from worker.detectors.siamese.prepared import PreparedEncoder

LEVELS = (
    Level(centres=256, radius=0.2, neighbours=32, widths=(64, 64, 128)),
    Level(centres=64, radius=0.4, neighbours=32, widths=(128, 128, 256)),
)
WHOLE = (256, 512, 1024)  #: widths of the last abstraction, over all that is left


class SharedLayers(nn.Module):
    """Normalised, rectified layers that every row goes through; the last is left to be rectified by the caller."""

    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            NormedLinear(before, after) for before, after in pairwise([inputs, *widths])
        )

    def forward(self, x: Tensor) -> Tensor:
        """(P, inputs) -> (P, widths[-1])"""
        *hidden, last = self.layers
        for layer in hidden:
            x = functional.relu_(layer(x))
        pooled: Tensor = last(x)
        return pooled


class SetAbstraction(nn.Module):
    """A local PointNet around every centre (Section 3.2 there)."""

    def __init__(self, features: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.shared = SharedLayers(3 + features, widths)

    def forward(self, points: Tensor, features: Tensor, centres: Tensor, neighbours: Tensor) -> Tensor:
        """Return the features (C, widths[-1]) of centres (C,) with neighbours (C, K), in the precision of `features`.

        They are rows of `points` (n, 3), metres, and of `features` (n, F). A maximum and a rectification may change
        places, so the fewer numbers are rectified.
        """
        offsets = (points[neighbours] - points[centres][:, None]).to(features.dtype)  # (C, K, 3)
        around = functional.embedding(
            neighbours, features
        )  # (C, K, F); its gradient is quicker than an index's
        rows = torch.cat([offsets, around], dim=2).flatten(0, 1)
        pooled = self.shared(rows).unflatten(0, neighbours.shape).max(dim=1).values
        return functional.relu(pooled)


class WholeAbstraction(nn.Module):
    """A PointNet over all that is left of each cloud."""

    def __init__(self, features: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.shared = SharedLayers(3 + features, widths)

    def forward(self, points: Tensor, features: Tensor, sizes: list[int]) -> Tensor:
        """(P, 3) and (P, F), B clouds of these sizes end to end -> (B, widths[-1])"""
        every = torch.split(self.shared(torch.cat([points.to(features.dtype), features], dim=1)), sizes)
        return functional.relu(torch.stack([rows.amax(dim=0) for rows in every]))


class PointNet2Encoder(PreparedEncoder[GroupedClouds]):
    """Points to an order-free descriptor, level by level."""

    descriptor = WHOLE[-1]

    def __init__(self) -> None:
        super().__init__()
        widths = [0, *(level.widths[-1] for level in LEVELS)]
        self.levels = nn.ModuleList(
            SetAbstraction(below, level.widths) for below, level in zip(widths, LEVELS, strict=False)
        )
        self.whole = WholeAbstraction(widths[-1], WHOLE)

    @staticmethod
    def prepare(clouds: Sequence[Points]) -> GroupedClouds:
        """Group the points of each."""
        return grouped(clouds, LEVELS)

    def forward(self, clouds: GroupedClouds) -> Tensor:
        """Return descriptors (B, 1024). A coarse training step has features in bfloat16, weights in float32."""
        weight = next(self.parameters())
        points = torch.from_numpy(clouds.points).to(weight.device)
        precision = torch.bfloat16 if self.training and self.coarse else torch.float32
        features = points.new_empty((len(points), 0), dtype=precision)  # the points themselves have none
        for abstraction, groups in zip(self.levels, clouds.levels, strict=True):
            centres, neighbours = (
                torch.from_numpy(rows).to(weight.device) for rows in (groups.centres, groups.neighbours)
            )
            features = abstraction(points, features, centres, neighbours)
            points = points[centres]
        descriptors: Tensor = self.whole(points, features, clouds.sizes)
        return descriptors.float()
