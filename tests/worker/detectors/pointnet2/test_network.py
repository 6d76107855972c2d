"""The encoder of PointNet++: its published shapes, and one set abstraction by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worker.detectors.pointnet2.network import LEVELS, WHOLE, PointNet2Encoder, SetAbstraction
from worker.detectors.siamese.layers import NormedLinear


def tile(points: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.uniform(-0.5, 0.5, (points, 3)) * (1.5, 1.5, 1.0)).astype(np.float32)


def test_levels_are_those_of_the_authors_for_rooms_and_the_end_is_that_of_their_classification():
    assert [(level.centres, level.radius, level.neighbours) for level in LEVELS] == [
        (256, 0.2, 32),
        (64, 0.4, 32),
    ]
    shapes = [
        tuple(weight.shape)
        for name, weight in PointNet2Encoder().named_parameters()
        if name.endswith("weight")
    ]
    assert shapes == [
        *[(64, 3), (64, 64), (128, 64)],
        *[(128, 131), (128, 128), (256, 128)],
        *[(256, 259), (512, 256), (1024, 512)],
    ]


def test_numbers_of_parameters():
    assert sum(parameter.numel() for parameter in PointNet2Encoder().parameters()) == 805_184


def test_a_set_abstraction_is_the_maximum_over_the_ball_by_hand():
    """One layer that passes an offset's x and its negative: the group's extent on either side of its centre."""
    abstraction = SetAbstraction(0, (2,)).eval()
    layer = abstraction.shared.layers[0]
    assert isinstance(layer, NormedLinear)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]]))
        layer.running_var.fill_(1 - 1e-5)
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [-0.3, 0, 0], [5.0, 0, 0]])
    centres, neighbours = torch.tensor([0, 3]), torch.tensor([[0, 1, 2], [3, 3, 3]])
    features = abstraction(points, torch.empty(4, 0), centres, neighbours)
    assert features.detach().numpy() == pytest.approx(np.array([[0.1, 0.3], [0, 0]]), abs=1e-6)


def test_features_of_the_level_below_are_grouped_with_the_offsets():
    abstraction = SetAbstraction(1, (1,)).eval()
    layer = abstraction.shared.layers[0]
    assert isinstance(layer, NormedLinear)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[0.0, 0, 0, 2.0]]))
        layer.running_var.fill_(1 - 1e-5)
    features = abstraction(
        torch.zeros(3, 3), torch.tensor([[1.0], [4.0], [9.0]]), torch.tensor([0]), torch.tensor([[0, 1, 0]])
    )
    assert features.item() == pytest.approx(8.0)


def test_a_descriptor_has_1024_numbers_and_tells_clouds_apart():
    encoder = PointNet2Encoder().eval()
    with torch.inference_mode():
        descriptors = encoder(encoder.prepare([tile(700, 1), tile(300, 2)]))
    assert descriptors.shape == (2, WHOLE[-1]) == (2, 1024)
    assert (descriptors[0] - descriptors[1]).abs().max() > 1e-3


def test_a_coarse_step_is_near_the_exact_one():
    """Half the digits, in training alone: the descriptors move by a tenth of what they spread by."""
    torch.manual_seed(0)
    encoder = PointNet2Encoder().train()
    clouds = encoder.prepare([tile(500, seed) for seed in range(4)])
    exact = encoder(clouds)
    encoder.coarse = True
    coarse = encoder(clouds)
    assert coarse.dtype == torch.float32
    assert 0 < (exact - coarse).abs().mean() < 0.15 * exact.std()
    encoder.eval()
    assert torch.equal(encoder(clouds), PointNet2Encoder.forward(encoder, clouds))
