"""The head trained alone, on descriptors computed once: the pairs are those of the whole training, and it learns."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from worker.detectors.siamese.chamfer import chamfer_statistics
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.training.dataset import save_tiles, split_tiles
from worker.training.head import train_head
from worker.training.kept_pairs import PairPool, keep_pairs
from worker.training.log import HEAD_LOG, LOG
from worker.training.pairs import PairSettings
from worker.training.settings import TrainSettings
from worker.training.trainer import BEST, train

SETTINGS = TrainSettings(
    train_pairs=200,
    head_epochs=12,
    head_batch=16,
    head_learning_rate=2e-3,
    head_validation_pairs=120,
    held_out=0.2,
    pairs=PairSettings(patch_points=256, edited_share=0.5),
)


KIND = SETTINGS.network


@pytest.fixture(scope="module")
def network() -> SpicdNetwork:
    torch.manual_seed(3)
    return SpicdNetwork().eval()


@pytest.fixture(scope="module")
def pool(tiles, network) -> PairPool:
    return keep_pairs(KIND, network, tiles, SETTINGS.pairs, seed=1)


def test_every_kind_of_pair_is_there_with_its_class(pool, tiles):
    counts = {name: (pairs.label, len(pairs.reference)) for name, pairs in pool.kinds.items()}
    assert counts.pop("different")[0] == 2
    assert counts == {
        "stored": (0, 40),
        "revisit": (0, 40),
        "beside": (0, 20),  # ten observations, each against both honest visits
        "untouched": (0, 10),
        "whole": (1, 20),
        "rebuilt": (1, 10),
        "synthetic": (1, 40),
    }


def test_classes_are_drawn_in_their_shares(pool):
    labels = np.bincount(pool.draw(2000, np.random.default_rng(0)).labels.numpy())
    assert labels.tolist() == pytest.approx([1000, 700, 300], abs=5)


def test_a_set_without_further_observations_makes_up_each_class_of_what_it_has(tiles, network):
    bare = keep_pairs(KIND, network, replace(tiles, observations=()), SETTINGS.pairs, seed=1)
    assert set(bare.kinds) == {"stored", "revisit", "synthetic", "different"}
    labels = np.bincount(bare.draw(2000, np.random.default_rng(0)).labels.numpy())
    assert labels.tolist() == pytest.approx([1000, 700, 300], abs=5)


def test_a_share_of_the_still_pairs_is_kept_with_noise_on_every_point(tiles, network):
    some = keep_pairs(KIND, network, tiles, replace(SETTINGS.pairs, noisy_share=0.25, noise=0.01), seed=1)
    assert {name for name in some.kinds if name.endswith(" noisy")} == {
        "stored noisy",
        "untouched noisy",
        "rebuilt noisy",
    }
    assert not some.kinds["stored"].statistics.any()
    means = np.expm1(some.kinds["stored noisy"].statistics[:, 0])
    assert means.min() > 0
    assert means.max() < 0.1  # noise of a centimetre, and the gaps that lost points leave
    drawn = some.draw(4000, np.random.default_rng(0))
    labels = np.bincount(drawn.labels.numpy())
    assert labels.tolist() == pytest.approx([2000, 1400, 600], abs=8)


def test_no_synthetic_change_is_encoded_that_no_pair_is_to_show(tiles, network):
    pairs = replace(SETTINGS.pairs, edited_share=0.65, rebuilt_share=0.35)
    kinds = keep_pairs(KIND, network, tiles, pairs, seed=1).kinds
    assert "synthetic" not in kinds


def test_different_places_are_3_m_apart_or_of_two_buildings(pool, tiles):
    pairs = pool.kinds["different"]
    for i, j in zip(pairs.reference.tolist(), pairs.current.tolist(), strict=True):
        apart = np.linalg.norm(
            tiles.centres[i] - tiles.centres[j]
        )  # the first rows are the tiles' first observations
        assert apart >= 3.0 or tiles.buildings[i] != tiles.buildings[j]


def test_kept_statistics_are_those_of_the_two_tiles_in_either_order(pool, tiles):
    kept = pool.kinds["revisit"].statistics[0]
    a, b = (torch.from_numpy(points[0]) for points in (tiles.points_a, tiles.points_b))
    assert kept == pytest.approx(chamfer_statistics([a], [b])[0].numpy(), abs=1e-6)
    assert np.roll(kept, 4) == pytest.approx(chamfer_statistics([b], [a])[0].numpy(), abs=1e-6)
    assert not pool.kinds["stored"].statistics.any()


def test_a_pair_that_is_drawn_turned_has_its_statistics_turned_too(tiles, network):
    visits = keep_pairs(
        KIND, network, replace(tiles, observations=()), replace(SETTINGS.pairs, shares=(1, 0, 0)), seed=1
    )
    drawn = visits.draw(400, np.random.default_rng(2))
    kept = visits.kinds["revisit"]
    ways = {"forth": 0, "back": 0}
    first, second = (network_rows(visits, rows) for rows in (kept.reference, kept.current))
    for reference, current, found in zip(drawn.reference, drawn.current, drawn.statistics, strict=True):
        for way, (a, b, shift) in {"forth": (first, second, 0), "back": (second, first, 4)}.items():
            here = ((a == reference).all(dim=1) & (b == current).all(dim=1)).nonzero()
            if len(here):
                assert np.array_equal(found.numpy(), np.roll(kept.statistics[int(here[0])], shift))
                ways[way] += 1
    assert min(ways.values()) > 50


def network_rows(pool: PairPool, rows: np.ndarray) -> torch.Tensor:
    return pool._descriptors[torch.from_numpy(rows)]


def test_the_same_generator_draws_the_same_pairs(pool):
    one, again = (pool.draw(600, np.random.default_rng(2)) for _ in range(2))
    assert torch.equal(one.statistics, again.statistics)
    assert torch.equal(one.labels, again.labels)


def test_the_head_learns_and_the_encoder_stays_as_it_was(tiles, tmp_path):
    torch.manual_seed(3)
    network = SpicdNetwork()
    encoder = {name: value.clone() for name, value in network.encoder.state_dict().items()}
    training, validation = split_tiles(tiles, share=0.2)
    found = train_head(network, training, validation, SETTINGS, tmp_path)
    with (tmp_path / HEAD_LOG).open() as file:
        log = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert [row["epoch"] for row in log] == list(range(1, 13))
    assert log[-1]["train_loss"] < 0.8 * log[0]["train_loss"]
    assert found.measured.accuracy == max(row["accuracy"] for row in log)
    assert found.best_epoch > 0
    after = network.encoder.state_dict()
    assert all(torch.equal(after[name], value) for name, value in encoder.items())


def test_a_training_ends_with_its_head_once_and_does_not_repeat_it(tiles, tmp_path):
    save_tiles(tiles, tmp_path / "tiles.npz")
    settings = replace(
        SETTINGS,
        epochs=1,
        batch=8,
        train_pairs=16,
        validation_pairs=8,
        head_epochs=2,
        head_validation_pairs=40,
    )
    best = train(settings, tmp_path / "tiles.npz", tmp_path / "run")
    state = torch.load(best, weights_only=True)
    assert state["head"]["epochs"] == 2
    assert state["settings"]["head_epochs"] == 2
    written = best.stat().st_mtime_ns
    train(settings, tmp_path / "tiles.npz", tmp_path / "run")
    assert best.stat().st_mtime_ns == written


def test_a_finished_training_may_be_given_more_of_the_head(tiles, tmp_path):
    save_tiles(tiles, tmp_path / "tiles.npz")
    bare = replace(SETTINGS, epochs=1, batch=8, train_pairs=16, validation_pairs=8, head_epochs=0)
    before = torch.load(train(bare, tmp_path / "tiles.npz", tmp_path / "run"), weights_only=True)
    more = replace(bare, head_epochs=2, head_validation_pairs=40)
    after = torch.load(train(more, tmp_path / "tiles.npz", tmp_path / "run"), weights_only=True)
    assert "head" not in before
    assert (after["epochs"], after["head"]["epochs"]) == (1, 2)


def test_the_head_alone_may_be_trained_on_another_trainings_encoder(tiles, tmp_path):
    save_tiles(tiles, tmp_path / "tiles.npz")
    first = replace(SETTINGS, epochs=1, batch=8, train_pairs=16, validation_pairs=8, head_epochs=0)
    start = train(first, tmp_path / "tiles.npz", tmp_path / "first")
    alone = replace(SETTINGS, epochs=0, head_epochs=2, head_validation_pairs=40, start_from=str(start))
    best = train(alone, tmp_path / "tiles.npz", tmp_path / "second")
    assert best.name == BEST
    assert not (tmp_path / "second" / LOG).exists()
    before, after = (torch.load(path, weights_only=True)["network"] for path in (start, best))
    same = {name: torch.equal(before[name], after[name]) for name in before}
    assert all(kept for name, kept in same.items() if name.startswith("encoder."))


@pytest.mark.parametrize("fresh", [True, False], ids=["of a checkpoint", "of nothing"])
def test_a_head_that_no_epoch_trains_begins_from_the_pool(tiles, tmp_path, network, fresh):
    """Its first layers hear of all their inputs: without that the products of descriptors drown the statistics."""
    save_tiles(tiles, tmp_path / "tiles.npz")
    torch.save({"network": network.state_dict()}, tmp_path / "encoder.pt")
    start = str(tmp_path / "encoder.pt") if fresh else None
    settings = replace(SETTINGS, epochs=0, head_epochs=1, start_from=start, fresh_head=fresh)
    begun = []
    for initialized in (True, False):
        run = replace(settings, initialize_head=initialized, head_learning_rate=0.0, final_learning_rate=0.0)
        best = train(run, tmp_path / "tiles.npz", tmp_path / str(initialized))
        begun.append(torch.load(best, weights_only=True)["network"])
    assert not torch.equal(begun[0]["head.chamfer.0.weight"], begun[1]["head.chamfer.0.weight"])
    encoders = [{name: one[name] for name in one if name.startswith("encoder.")} for one in begun]
    assert all(torch.equal(encoders[0][name], encoders[1][name]) for name in encoders[0])
