"""Many clouds at once are encoded as each by itself."""

from __future__ import annotations

import pytest
import torch

from worker.detectors.precision import Precision
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.together import TogetherEncoder, level


@pytest.fixture
def clouds() -> list[torch.Tensor]:
    torch.manual_seed(4)
    return [torch.rand(count, 3) - 0.5 for count in (300, 41, 256, 700)]


@torch.inference_mode()
def together(network, clouds: list[torch.Tensor], precision: Precision = "float32") -> torch.Tensor:
    centroids = torch.stack([cloud.mean(0) for cloud in clouds])
    return TogetherEncoder(network.encoder, precision)(level(clouds), centroids)


def test_clouds_are_brought_to_one_number_of_their_own_points(clouds):
    levelled = level(clouds)
    assert levelled.shape == (4, 768, 3)
    assert torch.equal(levelled[1, 41:82], clouds[1])
    assert torch.equal(levelled[3, :700], clouds[3])


def test_clouds_together_are_encoded_as_each_by_itself(network, clouds):
    alone = FrozenEncoder(network.encoder)
    expected = torch.stack([alone(cloud, cloud.mean(0)) for cloud in clouds])
    assert torch.allclose(together(network, clouds), expected, atol=1e-5)
    assert expected.std(dim=0).max() > 1e-3  # the clouds are told apart, so that equality says something


def test_a_cloud_is_encoded_the_same_whatever_is_beside_it(network, clouds):
    among = together(network, clouds)
    for row, cloud in enumerate(clouds):
        assert torch.allclose(together(network, [cloud])[0], among[row], atol=1e-5)


def test_in_bfloat16_the_winners_are_searched_and_their_values_are_exact(network, clouds):
    exact, coarse = together(network, clouds), together(network, clouds, "bfloat16")
    assert coarse.dtype == torch.float32
    assert not torch.equal(coarse, exact)
    assert (
        coarse <= exact + 0.02 * exact.abs().max()
    ).all()  # another point's value never passes the winner's
    assert torch.allclose(coarse, exact, atol=0.02 * float(exact.abs().max()))
