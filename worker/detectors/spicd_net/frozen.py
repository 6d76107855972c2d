"""The encoder as a processor runs it: weights folded once, each cloud in pieces that stay in the cache.

It takes a patch's distinct points, since a max-pool cannot see repeats; only the centroid knows of them. The
result is the descriptor of the padded patch within float32 rounding (a test holds it); with the winners of the
max-pools searched in 8 bits (`worker.detectors.siamese.search`) it is off by as much as the card's check says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from worker.detectors.siamese.layers import NormedLinear
from worker.detectors.siamese.parallel import in_groups
from worker.detectors.siamese.search import Maximum, exact_maximum, searched_maximum
from worker.detectors.spicd_net.network import PointEncoder, TransformNet

Layer = tuple[Tensor, Tensor]  #: weight (outputs, inputs), bias (outputs,)


def _frozen(layer: NormedLinear) -> Layer:
    weight, bias = layer.folded()
    return weight.detach().contiguous(), bias.detach().contiguous()


def _rectified(layer: Layer, x: Tensor) -> Tensor:
    return functional.relu_(functional.linear(x, *layer))


class _Pooled:
    """A layer that is max-pooled at once."""

    def __init__(self, layer: NormedLinear, maximum: Callable[[Tensor], Maximum]) -> None:
        self.weight, self._bias = _frozen(layer)
        self._maximum = maximum(self.weight)

    def __call__(self, x: Tensor) -> Tensor:
        """(m, inputs), rectified -> (outputs,); raises ValueError for a cloud without points."""
        if not len(x):
            raise ValueError("a cloud needs at least one point")
        return self._maximum(x) + self._bias


class _FrozenTransform:
    """A T-Net whose normalisation is folded into its weights."""

    def __init__(self, net: TransformNet, maximum: Callable[[Tensor], Maximum]) -> None:
        self.points1, self.points2, self.global1, self.global2 = map(
            _frozen, (net.points1, net.points2, net.global1, net.global2)
        )
        self.pooled = _Pooled(net.pooled, maximum)
        self.matrix, self.k = net.matrix, net.k

    def tensors(self) -> Iterator[Tensor]:
        """Yield what it holds but for the biases of pooled layers, a few KiB."""
        for layer in (self.points1, self.points2, self.global1, self.global2):
            yield from layer
        yield self.pooled.weight
        yield from self.matrix.state_dict().values()

    def matrices(self, clouds: Sequence[Tensor]) -> Tensor:
        """Return the transforms of n clouds (m, k): (n, k, k)."""
        features = (_rectified(self.points2, _rectified(self.points1, cloud)) for cloud in clouds)
        pooled = torch.stack([self.pooled(part) for part in features])
        # The layers behind the pool have 8 MB of weights: read once for all clouds.
        hidden = _rectified(self.global2, _rectified(self.global1, functional.relu_(pooled)))
        matrices: Tensor = self.matrix(hidden)
        return matrices.view(-1, self.k, self.k)


class FrozenEncoder:
    """`PointEncoder` in evaluation, for clouds of any number of points; `searched` looks for winners in 8 bits."""

    def __init__(self, encoder: PointEncoder, *, searched: bool = False) -> None:
        encoder.eval()
        maximum = searched_maximum if searched else exact_maximum
        self.input_transform = _FrozenTransform(encoder.input_transform, maximum)
        self.feature_transform = _FrozenTransform(encoder.feature_transform, maximum)
        self.mlp1, self.mlp2, self.mlp3 = map(_frozen, (encoder.mlp1, encoder.mlp2, encoder.mlp3))
        self.mlp4 = _Pooled(encoder.mlp4, maximum)

    def __call__(self, points: Tensor, centroid: Tensor) -> Tensor:
        """Encode distinct points (m, 3), with the padded patch's centroid (3,), as a descriptor (1024,)."""
        return self.encode([points], [centroid])[0]

    def tensors(self) -> Iterator[Tensor]:
        """Yield the weights that it holds."""
        yield from self.input_transform.tensors()
        yield from self.feature_transform.tensors()
        for layer in (self.mlp1, self.mlp2, self.mlp3):
            yield from layer
        yield self.mlp4.weight

    def encode(self, clouds: Sequence[Tensor], centroids: Sequence[Tensor]) -> Tensor:
        """Encode n clouds (m, 3), metres, with the centroids (3,) of their padded patches: (n, 1024).

        Each thread that torch has takes a share of the clouds, which wakes fewer threads than sharing every product.
        """
        pairs = list(zip(clouds, centroids, strict=True))
        return torch.cat(in_groups(self._encoded, pairs))

    @torch.inference_mode()
    def _encoded(self, pairs: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
        centred = [points - centroid for points, centroid in pairs]
        features = [
            _rectified(self.mlp2, _rectified(_after(transform, self.mlp1), cloud))  # (m, 64)
            for transform, cloud in zip(self.input_transform.matrices(centred), centred, strict=True)
        ]
        descriptors = [
            self.mlp4(_rectified(_after(transform, self.mlp3), part))  # (m, 128) -> (1024,)
            for transform, part in zip(self.feature_transform.matrices(features), features, strict=True)
        ]
        return torch.stack(descriptors)


def _after(transform: Tensor, layer: Layer) -> Layer:
    """Return the layer that takes `x` where the given one takes `x @ transform`."""
    weight, bias = layer
    return weight @ transform.t(), bias
