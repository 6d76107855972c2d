"""The maximum of a wide layer: exact as written out, and searched in 8 bits with the values of true points."""

from __future__ import annotations

import pytest
import torch

from worker.detectors.precision import has_bfloat16
from worker.detectors.siamese.search import PIECE, exact_maximum, searched_maximum

with_8_bits = pytest.mark.skipif(
    not has_bfloat16(torch.device("cpu")),
    reason="this processor has no products in 8 bits that could be used",
)


def cloud(points: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Rectified inputs (m, 128) and a weight (1024, 128)."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.relu(torch.randn(points, 128, generator=generator))
    return x, torch.randn(1024, 128, generator=generator) / 11


@pytest.mark.parametrize("points", [1, PIECE, PIECE + 1, 3 * PIECE + 5])
def test_the_exact_maximum_is_that_of_the_product(points: int) -> None:
    x, weight = cloud(points)
    assert torch.allclose(exact_maximum(weight)(x), (x @ weight.T).amax(dim=0), atol=1e-5)


@with_8_bits
@pytest.mark.parametrize("points", [1, PIECE, PIECE + 1, 3 * PIECE + 5])
def test_a_searched_maximum_is_the_value_of_a_point_and_all_but_the_largest(points: int) -> None:
    x, weight = cloud(points)
    outputs = x @ weight.T
    found = searched_maximum(weight)(x)
    assert ((found[None] - outputs).abs().amin(dim=0) < 1e-5).all()
    missed = outputs.amax(dim=0) - found
    assert missed.min() > -1e-5
    assert missed.max() < 0.05  # of values around 2.5
    assert (missed < 1e-5).float().mean() > 0.9


@with_8_bits
def test_a_winner_that_stands_out_is_found_on_whatever_scale_its_inputs_are() -> None:
    x, weight = cloud(2 * PIECE)
    scales = 10.0 ** torch.linspace(-6, 3, 128)
    x[300] *= 3
    found = searched_maximum(weight / scales)(x * scales)
    assert torch.allclose(found, (x @ weight.T).amax(dim=0), rtol=1e-2)


@with_8_bits
def test_inputs_that_no_point_has_and_outputs_that_weigh_nothing_are_zero() -> None:
    x, weight = cloud(40)
    x[:, :64], weight[3] = 0, 0
    found = searched_maximum(weight)(x)
    assert torch.isfinite(found).all()
    assert found[3] == 0
    assert torch.equal(searched_maximum(weight)(torch.zeros(5, 128)), torch.zeros(1024))


@with_8_bits
def test_a_maximum_does_not_depend_on_the_order_of_the_points() -> None:
    x, weight = cloud(PIECE)
    shuffled = x[torch.randperm(len(x), generator=torch.Generator().manual_seed(1))]
    assert torch.allclose(searched_maximum(weight)(x), searched_maximum(weight)(shuffled), atol=1e-2)
