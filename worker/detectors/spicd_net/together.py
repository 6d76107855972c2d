"""The encoder for many clouds at once, as a GPU wants it: each layer is one product over all points of a batch.

Clouds are brought to one number of points by repeating some, which no maximum sees. The descriptors are those of the
frozen encoder within float32 rounding (a test holds it).

In bfloat16 only the winners of the three pooled layers are searched, nine tenths of the work; their values are computed
in float32, as are all other layers. So only a winner that another point all but equals can be missed, and the value is
then that of the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from worker.detectors.precision import Precision
from worker.detectors.siamese.layers import NormedLinear
from worker.detectors.spicd_net.network import PointEncoder, TransformNet

MULTIPLE = (
    256  #: points of a cloud are filled up to a multiple of this, so that a device meets few different shapes
)


class _Folded(nn.Module):
    """A layer of `layers.NormedLinear` in evaluation, with its normalisation in its weights; rectified."""

    weight: Tensor
    bias: Tensor

    def __init__(self, layer: NormedLinear) -> None:
        super().__init__()
        weight, bias = layer.folded()
        self.register_buffer("weight", weight.detach().clone())
        self.register_buffer("bias", bias.detach().clone())

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs)"""
        return functional.relu(functional.linear(x, self.weight, self.bias))

    def behind(self, transforms: Tensor, x: Tensor) -> Tensor:
        """Return the layer of `x @ transforms`: (B, k, k), (B, N, k) -> (B, N, outputs)"""
        weight = self.weight @ transforms.transpose(1, 2)  # (B, outputs, k)
        return functional.relu(torch.baddbmm(self.bias, x, weight.transpose(1, 2)))


class _Pooled(_Folded):
    """A layer that is max-pooled at once, and its maximum over the points."""

    coarse_weight: Tensor | None

    def __init__(self, layer: NormedLinear, precision: Precision) -> None:
        super().__init__(layer)
        coarse = precision == "bfloat16"
        self.register_buffer("coarse_weight", self.weight.bfloat16() if coarse else None)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, inputs) -> (B, outputs), not rectified"""
        if self.coarse_weight is None:
            return functional.linear(x, self.weight).amax(dim=1) + self.bias  # of (B, N, outputs)
        winners = functional.linear(x.bfloat16(), self.coarse_weight).argmax(dim=1)  # (B, outputs)
        clouds = torch.arange(len(x), device=x.device)[:, None]
        return torch.einsum("boi,oi->bo", x[clouds, winners], self.weight) + self.bias


class _Transform(nn.Module):
    """A T-Net (`network.TransformNet`)."""

    def __init__(self, net: TransformNet, precision: Precision) -> None:
        super().__init__()
        self.points = nn.Sequential(_Folded(net.points1), _Folded(net.points2))
        self.pooled = _Pooled(net.pooled, precision)
        self.dense = nn.Sequential(_Folded(net.global1), _Folded(net.global2))
        self.matrix, self.k = net.matrix, net.k

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, k) -> (B, k, k)"""
        hidden = self.dense(functional.relu(self.pooled(self.points(x))))
        matrices: Tensor = self.matrix(hidden)
        return matrices.view(-1, self.k, self.k)


class TogetherEncoder(nn.Module):
    """`network.PointEncoder` in evaluation, for B clouds of as many points; every shape is that of its input."""

    def __init__(self, encoder: PointEncoder, precision: Precision = "float32") -> None:
        super().__init__()
        encoder.eval()
        self.input_transform = _Transform(encoder.input_transform, precision)
        self.feature_transform = _Transform(encoder.feature_transform, precision)
        self.mlp1, self.mlp2, self.mlp3 = map(_Folded, (encoder.mlp1, encoder.mlp2, encoder.mlp3))
        self.mlp4 = _Pooled(encoder.mlp4, precision)

    def forward(self, points: Tensor, centroids: Tensor) -> Tensor:
        """Encode clouds (B, N, 3), metres, with the centroids (B, 3) of the padded patches: (B, 1024)."""
        centred = points - centroids[:, None]
        features = self.mlp2(self.mlp1.behind(self.input_transform(centred), centred))  # (B, N, 64)
        features = self.mlp3.behind(self.feature_transform(features), features)  # (B, N, 128)
        descriptors: Tensor = self.mlp4(features)
        return descriptors


def level(clouds: Sequence[Tensor], multiple: int = MULTIPLE) -> Tensor:
    """Bring clouds (m, 3) to the same number N of points by repeating theirs: (B, N, 3).

    N is the largest m, rounded up to a multiple.
    """
    size = -(-max(map(len, clouds)) // multiple) * multiple
    return torch.stack([cloud[torch.arange(size, device=cloud.device) % len(cloud)] for cloud in clouds])
