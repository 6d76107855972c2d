"""From a checkpoint to a model that the service opens."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from worker.detectors.running.runtime import Runtime
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.store import open_detector, read_card
from worker.errors import DetectorUnavailable
from worker.training import publish as module
from worker.training.calibration import best_threshold, survey_pairs
from worker.training.dataset import save_tiles, split_tiles
from worker.training.log import HEAD_LOG, LOG
from worker.training.pairs import PairSettings
from worker.training.publish import DEVIATIONS, change_scores, deviations, publish
from worker.training.settings import PAPER, TrainSettings
from worker.training.trainer import train

SHORT = TrainSettings(
    epochs=1, batch=8, train_pairs=8, validation_pairs=8, held_out=0.2, pairs=PairSettings(patch_points=256)
)


@pytest.fixture(scope="module")
def store(tiles, tmp_path_factory):
    folder = tmp_path_factory.mktemp("publish")
    save_tiles(tiles, folder / "tiles.npz")
    best = train(SHORT, folder / "tiles.npz", folder / "run")
    publish(
        best,
        folder / "tiles.npz",
        folder / "store",
        unseen=folder / "tiles.npz",
        version="3",
        summary="for tests",
        command="pytest",
    )
    return folder / "store"


def opened(store: Path, name: str = "spicd-net/3") -> SpicdNet:
    detector = open_detector(store, name, device="cpu")
    assert isinstance(detector, SpicdNet)
    return detector


def test_a_published_model_opens_and_its_card_says_how_it_was_made(store):
    card = open_detector(store, "spicd-net/3", device="cpu").card
    assert card.detector_settings["patch_points"] == 256
    assert card.training["command"] == "pytest"
    assert card.training["settings"]["train_pairs"] == 8
    assert card.training["best_epoch"] == 1
    assert set(card.evaluation) == {"validation", "unseen buildings", "pairs"}


def test_the_threshold_is_the_best_on_the_held_out_tiles(store, tiles):
    detector = open_detector(store, "spicd-net/3", device="cpu")
    pairs = survey_pairs(split_tiles(tiles, share=0.2)[1], PairSettings(), seed=SHORT.seed)
    chosen = best_threshold(change_scores(detector, pairs), pairs)
    assert detector.card.threshold == pytest.approx(chosen.threshold, abs=0.03)  # float16 tiles in the file
    assert detector.card.evaluation["validation"]["f1"] == pytest.approx(chosen.f1, abs=0.05)


def test_a_published_model_holds_the_checkpoints_weights(store):
    state = torch.load(store.parent / "run" / "best.pt", weights_only=True)["network"]
    weights = opened(store).weights()
    assert weights.keys() == state.keys()
    for name, tensor in weights.items():
        assert torch.equal(tensor, state[name])


@pytest.mark.parametrize("turned", [False, True])
def test_of_a_base_and_what_became_of_it_the_one_that_ranks_better_is_published(store, tmp_path, turned):
    """Turned round, a network ranks as badly as it ranked well; as it was, training has brought nothing."""
    run, tiles = store.parent / "run", store.parent / "tiles.npz"
    base = opened(store)
    if turned:
        weights = {name: value.clone() for name, value in base.weights().items()}
        for name in ("weight", "bias"):
            weights[f"head.classifier.6.{name}"].neg_()
        base = SpicdNet.load(base.card, weights, torch.device("cpu"))
    folder = publish(run / "best.pt", tiles, tmp_path, summary="", beside={"base": base}, base="base")
    card = read_card(folder)
    areas = {name: card.evaluation[name]["area_under_roc"] for name in ("validation", "base")}
    kept = "kept" in card.training
    assert areas["validation"] == max(*areas.values(), card.training.get("trained", 0.0))
    assert kept == (areas["validation"] == areas["base"])
    if not turned:
        assert kept
    written = opened(tmp_path, "spicd-net/1").weights()
    expected = base.weights() if kept else torch.load(run / "best.pt", weights_only=True)["network"]
    assert all(torch.equal(written[name], expected[name]) for name in expected)


def test_the_trainings_log_comes_along_and_that_of_an_earlier_one_goes(store, tmp_path):
    run = store.parent / "run"
    assert (store / "spicd-net" / "3" / LOG).read_bytes() == (run / LOG).read_bytes()
    alone = tmp_path / "alone" / "best.pt"
    alone.parent.mkdir()
    alone.write_bytes((run / "best.pt").read_bytes())
    tiles, models = store.parent / "tiles.npz", tmp_path / "store"
    folder = publish(run / "best.pt", tiles, models, summary="")
    assert (folder / LOG).exists()
    assert not (folder / HEAD_LOG).exists()
    (alone.parent / HEAD_LOG).write_text("epoch,seconds\n1,2.0\n")
    assert publish(alone, tiles, models, summary="") == folder
    assert not (folder / LOG).exists()
    assert (folder / HEAD_LOG).read_bytes() == (alone.parent / HEAD_LOG).read_bytes()


def test_a_card_says_what_a_training_started_from_but_not_where_it_lay(store, tmp_path):
    run, tiles = store.parent / "run", store.parent / "tiles.npz"
    state = torch.load(run / "best.pt", weights_only=True)
    state["settings"]["start_from"] = str(run / "last.pt")
    torch.save(state, tmp_path / "best.pt")
    card = read_card(publish(tmp_path / "best.pt", tiles, tmp_path / "store", summary=""))
    assert card.training["settings"]["start_from"] == "run/last.pt"


def test_how_far_the_scores_move_in_bfloat16_is_measured_for_these_weights(store, tmp_path, monkeypatch):
    monkeypatch.setattr("worker.detectors.precision.has_bfloat16", lambda device: True)
    monkeypatch.setattr(module, "has_bfloat16", lambda device: True)
    checkpoint, tiles = store.parent / "run" / "best.pt", store.parent / "tiles.npz"
    card = read_card(publish(checkpoint, tiles, tmp_path, summary="", command="pytest"))
    assert set(card.precision) == {"cpu", "cuda"}
    for kind, check in card.precision.items():
        assert 0 < check.largest_score_difference < 0.05
        assert check.tiles > 20
        assert check.command == "pytest"
        assert card.holds_in_bfloat16(kind) is check.holds
    assert card.precision["cuda"].device.endswith("as a GPU computes")


def test_a_model_that_others_have_in_hand_stays_as_it_is(store, tmp_path, monkeypatch):
    """A base that is published again is the detector that a worker keeps warm for its surveys."""
    monkeypatch.setattr("worker.detectors.precision.has_bfloat16", lambda device: True)
    monkeypatch.setattr(module, "has_bfloat16", lambda device: True)
    base = opened(store)
    base.run_with(kept := Runtime(precision="bfloat16"))
    run, tiles = store.parent / "run", store.parent / "tiles.npz"
    card = read_card(
        publish(run / "best.pt", tiles, tmp_path, summary="", beside={"base": base}, base="base")
    )
    assert "kept" in card.training
    assert base._batches is kept.batches
    assert base._precision == "bfloat16"
    assert card.precision["cpu"].largest_score_difference > 0  # of float32, whatever the base computes in


def test_a_model_that_is_not_whole_is_not_in_the_store(store, tmp_path, monkeypatch):
    """What failed, or was killed, in the middle of writing takes nobody's place, and can be done again."""

    def fails(*_):
        raise KeyboardInterrupt

    checkpoint, tiles = store.parent / "run" / "best.pt", store.parent / "tiles.npz"
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(module, "_precision", fails)
        publish(checkpoint, tiles, tmp_path, summary="")
    assert list(tmp_path.glob("*/*/card.json")) == []
    folder = publish(checkpoint, tiles, tmp_path, summary="")
    assert opened(tmp_path, "spicd-net/1").card.model == "spicd-net/1"
    assert [path.name for path in tmp_path.iterdir()] == [folder.parent.name]


def test_where_no_processor_computes_so_nothing_is_said_of_it(store, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "has_bfloat16", lambda device: False)
    checkpoint, tiles = store.parent / "run" / "best.pt", store.parent / "tiles.npz"
    assert read_card(publish(checkpoint, tiles, tmp_path, summary="")).precision == {}


def test_a_card_names_the_deviations_of_its_own_training():
    assert deviations(asdict(PAPER)) == list(DEVIATIONS)
    ours = asdict(TrainSettings())
    assert len(deviations(ours)) == len(DEVIATIONS) + 9  # the density is the paper's
    ours["pairs"]["density"] = (0.05, 0.3)
    assert "change density is the range given in settings" in deviations(ours)


def test_other_detectors_are_measured_on_the_same_pairs(store, tmp_path):
    other = open_detector(store, "spicd-net/3", device="cpu")
    run = store.parent / "run" / "best.pt"
    folder = publish(
        run, store.parent / "tiles.npz", tmp_path, summary="", about={"map": "lobby"}, beside={"base": other}
    )
    card = read_card(folder)
    assert card.training["map"] == "lobby"
    assert card.evaluation["base"] == card.evaluation["validation"]  # the same weights and threshold


def test_another_cards_weights_are_refused(store):
    card = store / "spicd-net" / "3" / "card.json"
    text = card.read_text()
    card.write_text(json.dumps({**json.loads(text), "sha256": "0" * 64}))
    with pytest.raises(DetectorUnavailable, match="sha256"):
        open_detector(store, "spicd-net/3")
    card.write_text(text)
