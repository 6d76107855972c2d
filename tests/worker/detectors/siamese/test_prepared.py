"""What Siamese-PointNet++ and Siamese-KPConv promise alike: order, batches, kept embeddings, the store, training."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worker.cloud.tiling import TilePairs
from worker.detectors.card import Card, Preprocessing
from worker.detectors.comparison import Comparison
from worker.detectors.registry import trainable_detectors
from worker.detectors.running.runtime import Runtime
from worker.detectors.siamese.prepared import SiameseNetwork
from worker.detectors.siamese.prepared_detector import PreparedDetector
from worker.detectors.store import detector_class, open_detector, write_model
from worker.detectors.trainable import CHANGED, UNCHANGED, Pair, TrainableNetwork, network_class
from worker.errors import Cancelled, DetectorUnavailable

KEYS = ("kpconv", "pointnet2")
CPU = torch.device("cpu")


def card_of(key: str) -> Card:
    return Card(
        name=key,
        version="3",
        detector=key,
        summary="for tests",
        threshold=0.5,
        preprocessing=Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=64),
        detector_settings={"patch_points": 1024, "chamfer_points": None, "seed": 42},
        weights="weights.safetensors",
    )


def training_of(key: str) -> TrainableNetwork:
    return network_class(key)(patch_points=1024, chamfer_points=None, seed=42)


@pytest.fixture(scope="module", params=KEYS)
def key(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def network(key: str) -> SiameseNetwork:
    """Not trained, but its normalisation has seen tiles."""
    torch.manual_seed(0)
    kind, rng = training_of(key), np.random.default_rng(0)
    module = kind.build()
    assert isinstance(module, SiameseNetwork)
    with torch.no_grad():
        for _ in range(20):
            module.encoder(module.encoder.prepare([place(rng) for _ in range(4)]))
    return module.eval()


@pytest.fixture
def detector(key: str, network: SiameseNetwork) -> PreparedDetector:
    opened = detector_class(key).load(card_of(key), dict(network.state_dict()), CPU)
    assert isinstance(opened, PreparedDetector)
    return opened


def place(rng: np.random.Generator, *, box: bool = False) -> np.ndarray:
    """A floor of 5 cm and a wall, with noise of their own; a box on the floor where there is one."""
    steps = np.arange(-0.7, 0.71, 0.1)
    floor = np.stack(np.meshgrid(steps, steps, [-0.45], indexing="ij"), axis=-1).reshape(-1, 3)
    wall = np.stack(np.meshgrid([0.7], steps, steps[3:11], indexing="ij"), axis=-1).reshape(-1, 3)
    there = [floor, wall, *([rng.uniform(-0.3, 0.1, (60, 3))] if box else [])]
    points = np.concatenate(there)
    return (points + rng.normal(scale=0.005, size=points.shape)).astype(np.float32)


def descriptors(network: SiameseNetwork, *clouds: np.ndarray) -> np.ndarray:
    with torch.inference_mode():
        return network.encoder(network.encoder.prepare(clouds)).numpy()


def test_equal_clouds_have_equal_descriptors_and_others_have_not(network):
    rng = np.random.default_rng(1)
    cloud, other = place(rng), place(rng, box=True)
    one, same, different = descriptors(network, cloud, cloud.copy(), other)
    assert np.array_equal(one, same)
    assert np.abs(one - different).max() > 1e-3


def test_any_order_of_the_points_gives_the_same_descriptor(network):
    rng = np.random.default_rng(2)
    cloud = place(rng, box=True)
    one, turned = (descriptors(network, points) for points in (cloud, rng.permutation(cloud)))
    assert turned == pytest.approx(one, abs=1e-6)


def test_a_batch_gives_the_descriptors_of_its_clouds_alone(network):
    rng = np.random.default_rng(3)
    clouds = [place(rng, box=box)[: 120 + 90 * box] for box in (False, True, True)]
    together = descriptors(network, *clouds)
    alone = np.concatenate([descriptors(network, cloud) for cloud in clouds])
    assert together == pytest.approx(alone, abs=1e-5)


def test_a_kept_embedding_gives_the_same_scores_and_is_not_computed_again(detector, pairs, monkeypatch):
    comparison = Comparison.of_tiles(pairs)
    embedding = detector.encode_reference(comparison.reference, pairs.reference)
    assert embedding["descriptors"].shape == (5, detector.encoder_class.descriptor)
    fresh = detector.detect(comparison)
    encoded: list[int] = []
    prepare = detector.encoder_class.prepare

    def counted(clouds):
        encoded.append(len(clouds))
        return prepare(clouds)

    monkeypatch.setattr(detector.encoder_class, "prepare", staticmethod(counted))
    kept = detector.detect(comparison, embedding=embedding)
    assert np.array_equal(kept.probabilities, fresh.probabilities, equal_nan=True)
    assert sum(encoded) == pairs.observed.sum()


def test_scores_are_probabilities_where_observed_and_nan_elsewhere(detector, pairs):
    probabilities = detector.detect(Comparison.of_tiles(pairs)).probabilities
    assert np.isnan(probabilities).all(axis=1).tolist() == [False, False, True, False, False]
    assert probabilities[pairs.observed].sum(axis=1) == pytest.approx(1, abs=1e-5)


def test_an_embedding_of_another_map_is_refused(detector, pairs):
    embedding = {"descriptors": np.zeros((4, detector.encoder_class.descriptor), np.float32)}
    with pytest.raises(ValueError, match="another map or model"):
        detector.detect(Comparison.of_tiles(pairs), embedding=embedding)


def test_a_dismissed_job_stops_between_tiles(detector, pairs):
    def dismissed(stage: str, share: float) -> None:
        raise Cancelled("dismissed")

    with pytest.raises(Cancelled):
        detector.encode_reference(Comparison.of_tiles(pairs).reference, pairs.reference, progress=dismissed)


def test_the_store_keeps_weights_and_scores(key, detector, pairs: TilePairs, tmp_path):
    write_model(tmp_path / key / "3", card_of(key), detector.weights())
    opened = open_detector(tmp_path, f"{key}/3", device="cpu")
    before, after = (each.detect(Comparison.of_tiles(pairs)).probabilities for each in (detector, opened))
    assert np.array_equal(before, after, equal_nan=True)


def test_weights_of_another_network_are_refused(key):
    with pytest.raises(RuntimeError, match="state_dict"):
        detector_class(key).load(card_of(key), {"nothing": torch.zeros(1)}, CPU)


def test_both_are_trained_as_spicd_net_is():
    assert set(KEYS) < set(trainable_detectors())


@pytest.mark.slow
def test_training_steps_lower_the_loss_on_a_few_pairs(key):
    torch.manual_seed(1)
    rng = np.random.default_rng(4)
    labels = (UNCHANGED, CHANGED, UNCHANGED, CHANGED)
    pairs = [Pair(place(rng), place(rng, box=label == CHANGED), label) for label in labels]
    kind = training_of(key)
    network = kind.build(coarse_search=True)
    batch = kind.collate(pairs, rng)
    kind.initialize_from_data(network, [batch])
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    losses = []
    for _ in range(25):
        _, loss = kind.answer(network, batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])


def test_what_the_head_is_trained_on_alone_is_what_is_used(key, network):
    """`encode` gives the descriptors of a detector, and of each cloud what its Chamfer branch compares."""
    kind, clouds = (
        training_of(key),
        [place(np.random.default_rng(5)), place(np.random.default_rng(6), box=True)],
    )
    encoded, compared = kind.encode(network, clouds, lambda _stage, _share: None)
    assert encoded.numpy() == pytest.approx(descriptors(network, *clouds), abs=1e-5)
    assert [len(cloud) for cloud in compared] == [len(cloud) for cloud in clouds]
    statistics = kind.compare(compared[:1], compared[1:])
    assert statistics.shape == (1, 8)
    assert kind.swapped(statistics)[0].tolist() == [*statistics[0, 4:], *statistics[0, :4]]


def test_an_encoder_is_taken_over_without_its_head(key, network):
    kind = training_of(key)
    torch.manual_seed(9)
    fresh = kind.build()
    head = {name: value.clone() for name, value in fresh.state_dict().items() if name.startswith("head.")}
    kind.start_from(fresh, network.state_dict(), fresh_head=True)
    for name, value in fresh.state_dict().items():
        expected = head[name] if name in head else network.state_dict()[name]
        assert torch.equal(value, expected), name


def test_bfloat16_which_these_networks_do_not_have_is_refused_and_never_chosen(detector, key, monkeypatch):
    monkeypatch.setattr("worker.detectors.precision.has_bfloat16", lambda device: True)
    with pytest.raises(DetectorUnavailable, match=f"model {key}/3 computes in float32, not in bfloat16"):
        detector.run_with(Runtime(precision="bfloat16"))
    monkeypatch.setattr(Card, "holds_in_bfloat16", lambda card, kind: True)
    detector.run_with(Runtime(precision="auto"))
    assert detector._precision == "float32"
