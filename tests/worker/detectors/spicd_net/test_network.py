"""The network of Section 3.6: its shapes, its identities, and that the fast layers are the plain ones."""

from __future__ import annotations

import sys

import pytest
import torch
from torch import nn

from worker.detectors.card import MODEL_STORE
from worker.detectors.precision import has_bfloat16
from worker.detectors.siamese.chamfer import chamfer_statistics, nearest_distances, swapped
from worker.detectors.siamese.head import PairHead, fused
from worker.detectors.siamese.layers import Moments, NormedLinear, PooledLinear
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.network import SpicdNetwork, TransformNet
from worker.detectors.store import open_detector, weights_of

SIZES = [40, 25, 60]


@pytest.fixture
def clouds() -> torch.Tensor:
    torch.manual_seed(1)
    return torch.randn(sum(SIZES), 6)


def plain(layer: NormedLinear) -> tuple[nn.Linear, nn.BatchNorm1d]:
    """The same layer, written out: the second after the first."""
    outputs, inputs = layer.weight.shape
    linear, norm = nn.Linear(inputs, outputs, bias=False), nn.BatchNorm1d(outputs)
    with torch.no_grad():
        linear.weight.copy_(layer.weight)
        norm.weight.copy_(layer.gamma)
        norm.bias.copy_(layer.beta)
    return linear, norm


def close(a: torch.Tensor | None, b: torch.Tensor | None, *, atol: float) -> bool:
    """Whether both are there, as a gradient need not be, and alike."""
    return a is not None and b is not None and torch.allclose(a, b, atol=atol)


def lived_in(layer: NormedLinear) -> NormedLinear:
    with torch.no_grad():
        layer.gamma.copy_(torch.randn(len(layer.gamma)))  # of either sign: a maximum may become a minimum
        layer.beta.copy_(torch.randn(len(layer.beta)))
    return layer


def test_a_normed_linear_is_linear_then_batch_norm_with_its_gradients_and_running_statistics(clouds):
    layer = lived_in(NormedLinear(6, 9))
    linear, norm = plain(layer)
    x, y = clouds.clone().requires_grad_(), clouds.clone().requires_grad_()
    weights = torch.randn(len(clouds), 9)
    (layer(x) * weights).sum().backward()
    (norm(linear(y)) * weights).sum().backward()
    assert torch.allclose(layer(clouds), norm(linear(clouds)), atol=1e-5)
    assert close(x.grad, y.grad, atol=1e-5)
    assert close(layer.weight.grad, linear.weight.grad, atol=1e-4)
    assert close(layer.running_mean, norm.running_mean, atol=1e-6)
    assert close(layer.running_var, norm.running_var, atol=1e-5)


def test_a_pooled_linear_is_linear_batch_norm_and_max_with_its_gradients(clouds):
    layer = lived_in(PooledLinear(6, 9))
    linear, norm = plain(layer)
    x, y = clouds.clone().requires_grad_(), clouds.clone().requires_grad_()
    pooled = layer(x, SIZES)
    written_out = torch.stack([cloud.amax(0) for cloud in norm(linear(y)).split(SIZES)])
    weights = torch.randn_like(pooled)
    (pooled * weights).sum().backward()
    (written_out * weights).sum().backward()
    assert torch.allclose(pooled, written_out, atol=1e-5)
    assert close(x.grad, y.grad, atol=1e-5)
    assert close(layer.weight.grad, linear.weight.grad, atol=1e-4)


def test_the_gradient_of_the_moments_is_the_numerical_one():
    assert torch.autograd.gradcheck(Moments.apply, torch.randn(20, 4, dtype=torch.double, requires_grad=True))


@pytest.mark.parametrize("k", [3, 64])
def test_an_untrained_t_net_gives_the_identity(k):
    net = TransformNet(k).eval()
    assert torch.equal(net(torch.randn(50, k), [20, 30]), torch.eye(k).repeat(2, 1, 1))


def test_the_layers_have_the_papers_widths():
    net = SpicdNetwork()
    widths = [tuple(m.weight.shape) for m in net.head.modules() if isinstance(m, nn.Linear)]
    assert widths == [(64, 8), (32, 64), (256, 2080), (128, 256), (3, 128)]
    encoder = net.encoder
    shapes = [tuple(m.weight.shape) for m in (encoder.mlp1, encoder.mlp2, encoder.mlp3, encoder.mlp4)]
    assert shapes == [(64, 3), (64, 64), (128, 64), (1024, 128)]


def test_a_descriptor_does_not_depend_on_the_order_of_the_points(network):
    cloud = torch.rand(150, 3) - 0.5
    with torch.no_grad():
        first, again = (network.encoder(c, [150])[0] for c in (cloud, cloud[torch.randperm(150)]))
    assert torch.allclose(first, again, atol=1e-5)


def test_a_cloud_is_encoded_the_same_alone_and_among_others(network):
    cloud, other = torch.rand(150, 3) - 0.5, torch.rand(70, 3) - 0.5
    with torch.no_grad():
        alone = network.encoder(cloud, [150])[0][0]
        among = network.encoder(torch.cat([other, cloud]), [70, 150])[0][1]
    assert torch.allclose(alone, among, atol=1e-5)


def test_the_frozen_encoder_on_distinct_points_is_the_network_on_repeated_ones(network):
    cloud = torch.rand(700, 3) - 0.5  # more than one piece
    repeated = torch.cat([cloud, cloud, cloud[:100]])
    with torch.no_grad():
        expected = network.encoder(repeated - repeated.mean(0), [1500])[0][0]
    found = FrozenEncoder(network.encoder)(cloud, repeated.mean(0))
    assert torch.allclose(found, expected, atol=1e-5)
    assert expected.std() > 0.01  # the network tells channels apart, so that the line above says something


with_8_bits = pytest.mark.skipif(
    not has_bfloat16(torch.device("cpu")),
    reason="this processor has no products in 8 bits that could be used",
)


@pytest.mark.parametrize("searched", [False, pytest.param(True, marks=with_8_bits)])
def test_the_frozen_encoder_encodes_each_of_several_clouds_as_it_does_alone(network, searched):
    clouds = [torch.rand(points, 3) - 0.5 for points in (700, 30, 256, 1)]
    encoder = FrozenEncoder(network.encoder, searched=searched)
    centroids = [cloud.mean(0) for cloud in clouds]
    alone = torch.stack([encoder(*pair) for pair in zip(clouds, centroids, strict=True)])
    assert torch.allclose(encoder.encode(clouds, centroids), alone, atol=1e-5)


@with_8_bits
def test_a_searched_encoder_is_all_but_the_exact_one(network):
    clouds = [torch.rand(700, 3) - 0.5 for _ in range(4)]
    centroids = [cloud.mean(0) for cloud in clouds]
    exact, searched = (FrozenEncoder(network.encoder, searched=way) for way in (False, True))
    off = (searched.encode(clouds, centroids) - exact.encode(clouds, centroids)).abs()
    assert 0 < off.max() < 0.02
    assert off.mean() < 1e-3


@with_8_bits
def test_the_scores_of_the_shipped_weights_hold_where_winners_are_searched():
    """Tiles of walls, floors and boxes; docs/decisions/0041 has the difference on 172 simulated tiles."""
    generator = torch.Generator().manual_seed(0)
    walls = torch.rand(24, 900, 3, generator=generator) * torch.tensor([1.5, 1.5, 1.0]) - 0.5
    walls[:, :300, 2], walls[:, 300:600, 0] = -0.5, -0.5
    boxes = torch.rand(12, 400, 3, generator=generator) * 0.4
    before = [*walls]
    after = [torch.cat(pair) for pair in zip(walls[:12], boxes, strict=True)] + [*walls[12:]]
    network = SpicdNetwork()
    network.load_state_dict(weights_of(open_detector(MODEL_STORE, "spicd-net/1", "cpu")))
    statistics = chamfer_statistics(before, after)
    scores = []
    with torch.inference_mode():
        for searched in (False, True):
            encoder = FrozenEncoder(network.eval().encoder, searched=searched)
            sides = [encoder.encode(clouds, [c.mean(0) for c in clouds]) for clouds in (before, after)]
            scores.append(1 - network.head(*sides, statistics).softmax(dim=1)[:, 0])
    exact, coarse = scores
    assert exact.max() - exact.min() > 0.2  # they tell the tiles apart
    assert (coarse - exact).abs().max() < 2e-3


def test_a_cloud_without_points_is_refused(network):
    with pytest.raises(ValueError, match="at least one point"):
        FrozenEncoder(network.encoder)(torch.empty(0, 3), torch.zeros(3))


def test_chamfer_statistics_of_a_shifted_copy_are_the_shift():
    grid = torch.stack(torch.meshgrid(*[torch.arange(5.0)] * 3, indexing="ij"), -1).reshape(125, 3)
    shifted = grid + torch.tensor([0.0, 0.0, 0.3])
    expected = torch.full((1, 8), 1.3).log()
    assert torch.allclose(chamfer_statistics([grid], [shifted]), expected, atol=1e-4)


def test_chamfer_statistics_see_the_lone_point_in_its_direction_only():
    near = torch.zeros(128, 3)
    far = near.clone()
    far[0, 0] = 2.0
    statistics = chamfer_statistics([near], [far]).expm1()
    assert statistics[0].tolist() == pytest.approx([0, 0, 0, 0, 2 / 128, 2, 0, 0], abs=1e-5)


def test_a_cloud_and_itself_in_another_order_are_at_distance_zero_to_the_bit():
    cloud = torch.rand(300, 3)
    assert not chamfer_statistics([cloud], [cloud[torch.randperm(300)]]).any()


def test_clouds_of_a_batch_are_compared_pair_by_pair_whatever_their_sizes():
    clouds = [torch.rand(size, 3) for size in (40, 70, 55, 30)]
    together = chamfer_statistics(clouds[:2], clouds[2:])
    alone = [chamfer_statistics([clouds[i]], [clouds[i + 2]])[0] for i in range(2)]
    assert torch.equal(together, torch.stack(alone))


def test_point_counts_by_hand_three_points_more_of_which_two_are_far():
    before = torch.arange(20.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    added = torch.tensor([[0.0, 0.03, 0.0], [1.0, 0.06, 0.0], [2.0, 0.3, 0.0]])  # beyond 2.5; 5; all three
    counts = chamfer_statistics([before], [torch.cat([before, added])], counts=True)[0, 8:]
    expected = torch.tensor([-4.0, 1, 1, 1, 4, 4, 3, 2]).abs().log() * torch.tensor([-1.0] + [1.0] * 7)
    assert torch.allclose(counts, expected)


def test_of_a_pair_turned_round_every_statistic_is_turned_round():
    a, b = torch.rand(200, 3), torch.rand(150, 3)
    forth, back = (chamfer_statistics([one], [other], counts=True) for one, other in ((a, b), (b, a)))
    assert torch.allclose(swapped(forth), back)
    assert torch.allclose(swapped(forth[:, :8]), back[:, :8])
    assert forth[0, 8] == -back[0, 8]  # fifty points fewer, fifty more


def test_a_head_with_counts_has_sixteen_statistics_and_one_without_the_papers_eight():
    assert [PairHead(1024, counts=counts).chamfer[0].in_features for counts in (False, True)] == [8, 16]


def test_the_tree_finds_the_distances_of_all_pairs(monkeypatch):
    a, b = torch.rand(200, 3), torch.rand(150, 3)
    by_tree = nearest_distances(a, b)
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)  # as on a machine that only trains
    for found, expected in zip(by_tree, nearest_distances(a, b), strict=True):
        assert torch.allclose(found, expected, atol=1e-6)


def test_the_chamfer_feature_is_gated_in_training_only():
    head = PairHead(1024)
    for layer in head.classifier:
        if isinstance(layer, nn.Dropout):
            layer.p = 0.0
    descriptors = torch.zeros(400, 1024)
    statistics = torch.ones(400, 8)
    in_use = head.eval()(descriptors, descriptors, statistics)
    assert torch.allclose(in_use, in_use[:1].expand_as(in_use), atol=1e-6)
    torch.manual_seed(0)
    gated = (head.train()(descriptors, descriptors, statistics) - in_use[0]).abs().amax(1) > 1e-6
    assert 0.12 < gated.float().mean() < 0.28  # 0.2 of 400, four sigmas either way


def test_a_head_initialised_from_data_hears_every_block_of_its_input_alike():
    torch.manual_seed(0)
    head = PairHead(1024).eval()
    base = 5 * torch.randn(600, 1024)
    reference, current = base, base + 0.1 * torch.randn(600, 1024)
    statistics = 0.1 + 0.02 * torch.rand(600, 8)
    head.initialize_from_data(reference, current, statistics)
    first = head.classifier[0]
    assert isinstance(first, nn.Linear)
    blocks = fused(reference, current, head.chamfer(statistics)).split([1024, 1024, 32], dim=1)
    weights = first.weight.split([1024, 1024, 32], dim=1)
    spread = [float((x @ w.t()).detach().std(dim=0).mean()) for x, w in zip(blocks, weights, strict=True)]
    assert max(spread) < 2 * min(spread)
    whole = first(torch.cat(blocks, dim=1)).mean(dim=0)
    assert whole.abs().max() < 0.1  # the bias alone: U(-1, 1) / sqrt(2080)
