"""The encoder as it is used: weights folded once, one cloud at a time, in pieces that stay in the cache.

It takes a patch's distinct points, since a max-pool cannot see repeats; only the centroid knows of them. The
result is the descriptor of the padded patch within float32 rounding (a test holds it).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from worker.detectors.siamese.layers import NormedLinear
from worker.detectors.spicd_net.network import PointEncoder, TransformNet

Layer = tuple[Tensor, Tensor]  #: weight (outputs, inputs), bias (outputs,)

#: Points of a piece: 1,024 outputs of 256 points are 1 MiB, a core's second-level cache (best of 64 to 4,096).
CPU_PIECE = 256


def _frozen(layer: NormedLinear) -> Layer:
    weight, bias = layer.folded()
    return weight.detach().contiguous(), bias.detach().contiguous()


def _rectified(layer: Layer, x: Tensor) -> Tensor:
    return functional.relu_(functional.linear(x, *layer))


class FrozenTransform:
    """A T-Net whose normalisation is folded into its weights."""

    def __init__(self, net: TransformNet) -> None:
        self.points1, self.points2, self.pooled = map(_frozen, (net.points1, net.points2, net.pooled))
        self._from_pooled = net.from_pooled

    def matrix(self, x: Tensor, piece: int) -> Tensor:
        """Return the transform of a cloud, (m, k) -> (k, k)."""
        highest = highest_of(x, (self.points1, self.points2), self.pooled, piece)
        return self._from_pooled(functional.relu(highest)[None])[0]


class FrozenEncoder:
    """`PointEncoder` in evaluation, for one cloud of any number of points."""

    def __init__(self, encoder: PointEncoder) -> None:
        encoder.eval()
        self.input_transform = FrozenTransform(encoder.input_transform)
        self.feature_transform = FrozenTransform(encoder.feature_transform)
        self.mlp1, self.mlp2, self.mlp3, self.mlp4 = map(
            _frozen, (encoder.mlp1, encoder.mlp2, encoder.mlp3, encoder.mlp4)
        )

    @torch.inference_mode()
    def __call__(self, points: Tensor, centroid: Tensor) -> Tensor:
        """Encode distinct points (m, 3), with the padded patch's centroid (3,), as a descriptor (1024,)."""
        piece = CPU_PIECE if points.device.type == "cpu" else len(points)
        centred = points - centroid
        a3 = self.input_transform.matrix(centred, piece)
        features = _rectified(self.mlp2, _rectified(_after(a3, self.mlp1), centred))  # (m, 64)
        a64 = self.feature_transform.matrix(features, piece)
        return highest_of(features, (_after(a64, self.mlp3),), self.mlp4, piece)


def _after(transform: Tensor, layer: Layer) -> Layer:
    """Return the layer that takes `x` where the given one takes `x @ transform`."""
    weight, bias = layer
    return weight @ transform.t(), bias


def highest_of(x: Tensor, layers: tuple[Layer, ...], pooled: Layer, piece: int) -> Tensor:
    """Return `pooled` behind rectified `layers`, and its maximum over the points."""
    weight, bias = pooled
    highest: Tensor | None = None
    for part in torch.split(x, piece):
        for layer in layers:
            part = _rectified(layer, part)  # noqa: PLW2901
        here = (weight @ part.t()).amax(dim=1)  # (outputs, piece) -> (outputs,)
        highest = here if highest is None else torch.maximum(highest, here)
    if highest is None:
        raise ValueError("a cloud needs at least one point")
    return highest + bias
