"""The encoder of KPConv: its published shapes, and one convolution by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worker.detectors.kpconv.network import (
    KernelPointConvolution,
    KPConvEncoder,
    Stage,
    correlations,
    highest,
)
from worker.detectors.kpconv.pyramid import Neighbours

#: Four neighbours of one centre, at distances 0, 0.5, 1 and 2 along x.
POINTS = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
ALL = Neighbours(centres=np.zeros(4, np.int64), points=np.arange(4), counts=np.array([4]))


def kernel() -> torch.Tensor:
    """The first of fifteen points in the middle, the second at x = 1, the others far away."""
    points = torch.full((15, 3), 50.0)
    points[0], points[1] = 0.0, torch.tensor([1.0, 0, 0])
    return points


def test_a_kernel_point_acts_on_a_neighbour_linearly_less_with_distance():
    found = correlations(POINTS[:1], POINTS, ALL, kernel(), sigma=1.0).to_dense()
    assert found.shape == (15, 4)
    assert found[0].tolist() == [1.0, 0.5, 0.0, 0.0]
    assert found[1].tolist() == [0.0, 0.5, 1.0, 0.0]
    assert not found[2:].any()


def test_a_convolution_adds_up_the_weighted_neighbours_of_each_kernel_point_by_hand():
    convolution = KernelPointConvolution(1, 1).eval()
    with torch.no_grad():
        assert convolution.unary.norm.running_var is not None
        convolution.unary.norm.running_var.fill_(1 - 1e-5)
        convolution.unary.linear.weight.zero_()
        convolution.unary.linear.weight[0, :2] = torch.tensor([10.0, 1.0])
    features = torch.tensor([[1.0], [2.0], [3.0], [4.0]])
    found = convolution(correlations(POINTS[:1], POINTS, ALL, kernel(), sigma=1.0), features)
    # middle: 1 * 1 + 0.5 * 2 = 2; beside it: 0.5 * 2 + 1 * 3 = 4
    assert found.item() == pytest.approx(10 * 2 + 1 * 4, rel=1e-4)


def test_twice_the_size_with_twice_the_sigma_is_the_same():
    one = correlations(POINTS[:1], POINTS, ALL, kernel(), sigma=1.0).to_dense()
    other = correlations(2 * POINTS[:1], 2 * POINTS, ALL, 2 * kernel(), sigma=2.0).to_dense()
    assert torch.allclose(one, other)


def test_the_way_beside_a_rising_convolution_takes_each_centres_maximum():
    below = Neighbours(centres=np.array([0, 0, 1]), points=np.array([0, 2, 1]), counts=np.array([2, 1]))
    features = torch.tensor([[1.0, 9.0], [5.0, -5.0], [3.0, 0.0]], requires_grad=True)
    pooled = highest(features, below)
    assert pooled.tolist() == [[3.0, 9.0], [5.0, -5.0]]
    pooled.sum().backward()
    assert features.grad is not None
    assert features.grad.tolist() == [[0, 1], [1, 1], [1, 0]]


def test_four_levels_of_the_authors_widths():
    encoder = KPConvEncoder()
    convolutions = {
        name.removesuffix(".unary.linear.weight"): tuple(weight.shape)
        for name, weight in encoder.named_parameters()
        if name.endswith("unary.linear.weight")
    }
    assert convolutions["stages.0.begin"] == (32, 15 * 4)
    inner = {name: shape for name, shape in convolutions.items() if name.endswith("convolution")}
    widths = [16, 32, 64, 128]
    assert len(inner) == 10
    for name, shape in inner.items():
        width = widths[int(name.split(".")[1])]
        assert shape == (width, 15 * width)
    assert encoder.descriptor == 512


def test_numbers_of_parameters():
    assert sum(parameter.numel() for parameter in KPConvEncoder().parameters()) == 1_260_096


def test_a_descriptor_is_the_mean_of_the_last_level():
    encoder = KPConvEncoder().eval()
    rng = np.random.default_rng(0)
    clouds = [(rng.uniform(-0.5, 0.5, (n, 3)) * (1.5, 1.5, 0.1)).astype(np.float32) for n in (500, 200)]
    seen = []
    last = encoder.stages[-1]
    assert isinstance(last, Stage)
    last.register_forward_hook(lambda _module, _given, made: seen.append(made))
    made = encoder.prepare(clouds)
    with torch.inference_mode():
        descriptors = encoder(made)
    (features,) = seen
    assert features.shape == (sum(made.sizes), 512)
    assert torch.allclose(descriptors[1], features[made.sizes[0] :].mean(dim=0))
    assert (descriptors[0] - descriptors[1]).abs().max() > 1e-3
