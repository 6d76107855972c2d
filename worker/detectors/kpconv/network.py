"""The encoder of KPConv, rigid (Thomas et al. 2019, Section 3.3): four of its authors' five levels, and their mean.

Every convolution of a level has the same kernel points, so the correlations are computed once a level. They are few:
a kernel point acts on a fifteenth of the ball or so. So they are a sparse matrix, and no neighbourhood is padded.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from worker.cloud.types import Points
from worker.detectors.kpconv.kernel_points import POINTS, kernel_points
from worker.detectors.kpconv.pyramid import Neighbours, Pyramid, pyramid
from worker.detectors.siamese.prepared import PreparedEncoder

CELL = 0.05  #: metres, of the first level, which a map at 5 cm is as it comes
LEVELS = 4
REACH = 2.5  #: radius of a convolution, in cells of its level; sigma is one cell
WIDTH = 64  #: features of the first level; they double from level to level
FEATURES = 4  #: of a point of the input: 1, and where it lies in the tile
SLOPE = 0.1  #: of a rectification below zero


class Unary(nn.Module):
    """A layer that every point goes through, normalised."""

    def __init__(self, inputs: int, outputs: int, *, rectified: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)
        self.rectified = rectified

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs) -> (n, outputs)"""
        x = self.norm(self.linear(x))
        return functional.leaky_relu(x, SLOPE) if self.rectified else x


class KernelPointConvolution(nn.Module):
    """A weight matrix a kernel point (equation 2 there), normalised and rectified."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.unary = Unary(POINTS * inputs, outputs)

    def forward(self, correlations: Tensor, features: Tensor) -> Tensor:
        """Return (C, outputs) of features (n, inputs), by correlations, sparse (C * 15, n)."""
        gathered = torch.sparse.mm(correlations, features)  # (C * 15, inputs)
        x: Tensor = self.unary(gathered.view(-1, POINTS * features.shape[1]))
        return x


class Residual(nn.Module):
    """A bottleneck: fewer features, a convolution, more features, and the input beside it."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        inner = outputs // 4
        self.down = Unary(inputs, inner) if inputs != inner else nn.Identity()
        self.convolution = KernelPointConvolution(inner, inner)
        self.up = Unary(inner, outputs, rectified=False)
        self.beside = Unary(inputs, outputs, rectified=False) if inputs != outputs else nn.Identity()

    def forward(self, correlations: Tensor, features: Tensor, below: Neighbours | None = None) -> Tensor:
        """Return (C, outputs) of features (n, inputs); with `below` the centres are those of the level above."""
        x = self.up(self.convolution(correlations, self.down(features)))
        beside = features if below is None else highest(features, below)
        return functional.leaky_relu(x + self.beside(beside), SLOPE)


class Stage(nn.Module):
    """The convolutions of one level, and the one that leads to the next."""

    def __init__(self, inputs: int, outputs: int, *, first: bool, last: bool) -> None:
        super().__init__()
        self.begin = KernelPointConvolution(inputs, outputs // 2) if first else Residual(inputs, outputs)
        self.go_on = Residual(outputs // 2 if first else outputs, outputs)
        self.rise = None if last else Residual(outputs, outputs)

    def forward(
        self, features: Tensor, around: Tensor, rising: Tensor | None = None, below: Neighbours | None = None
    ) -> Tensor:
        """Return features of the next level, or on the last of this; (n, inputs) -> (C, outputs).

        `around` are the correlations within the level, `rising` those of the next level's points with its `below`.
        """
        features = self.go_on(around, self.begin(around, features))
        if self.rise is None:
            return features
        risen: Tensor = self.rise(rising, features, below)
        return risen


class KPConvEncoder(PreparedEncoder[Pyramid]):
    """Points to a descriptor: the mean over the last level."""

    descriptor = WIDTH * 2 ** (LEVELS - 1)
    kernel: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("kernel", torch.from_numpy(kernel_points().copy()).float())
        widths = [WIDTH * 2**level for level in range(LEVELS)]
        self.stages = nn.ModuleList(
            Stage(before, width, first=level == 0, last=level == LEVELS - 1)
            for level, (before, width) in enumerate(zip([FEATURES, *widths], widths, strict=False))
        )

    @staticmethod
    def prepare(clouds: Sequence[Points]) -> Pyramid:
        """Subsample each and find its neighbours."""
        return pyramid(clouds, cell=CELL, levels=LEVELS, reach=REACH)

    def forward(self, clouds: Pyramid) -> Tensor:
        """Return descriptors (B, 512)."""
        device = self.kernel.device
        points = [torch.from_numpy(level).to(device) for level in clouds.points]
        features = torch.cat([torch.ones_like(points[0][:, :1]), points[0]], dim=1)
        for level, stage in enumerate(self.stages):
            sigma, here = CELL * 2**level, points[level]
            kernel = self.kernel * sigma
            around = correlations(here, here, clouds.within[level], kernel, sigma)
            if level == LEVELS - 1:
                features = stage(features, around)
                break
            below = clouds.below[level]
            rising = correlations(points[level + 1], here, below, kernel, sigma)
            features = stage(features, around, rising, below)
        return torch.stack([cloud.mean(dim=0) for cloud in torch.split(features, clouds.sizes)])


@torch.no_grad()
def correlations(
    centres: Tensor, points: Tensor, neighbours: Neighbours, kernel: Tensor, sigma: float
) -> Tensor:
    """Return how much each kernel point acts on each neighbour, sparse (C * 15, n).

    It is max(0, 1 - |y - x_k| / sigma) for a neighbour at y from its centre and a kernel point at x_k (equation 6
    there). Centres (C, 3), points (n, 3), kernel (15, 3) and sigma are in metres.
    """
    rows, columns = (
        torch.from_numpy(part).to(points.device) for part in (neighbours.centres, neighbours.points)
    )
    offsets = points[columns] - centres[rows]  # (E, 3)
    acting = 1 - torch.cdist(offsets, kernel, compute_mode="donot_use_mm_for_euclid_dist") / sigma  # (E, 15)
    pair, point = torch.nonzero(acting > 0, as_tuple=True)
    places = torch.stack([rows[pair] * POINTS + point, columns[pair]])
    shape = (len(centres) * POINTS, len(points))
    return torch.sparse_coo_tensor(places, acting[pair, point], shape, check_invariants=False)


def highest(features: Tensor, below: Neighbours) -> Tensor:
    """Return the maximum (C, F) of features (n, F) over each centre's neighbours."""
    rows, counts = (torch.from_numpy(part).to(features.device) for part in (below.points, below.counts))
    around = functional.embedding(rows, features)
    pooled: Tensor = torch.segment_reduce(around, "max", lengths=counts, axis=0)
    return pooled
