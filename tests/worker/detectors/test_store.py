"""A model is opened only if its files are those of its card."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from worker.detectors.card import MODEL_STORE
from worker.detectors.comparison import Comparison
from worker.detectors.running.runtime import Runtime
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.store import open_card, open_detector, weights_of, write_model
from worker.errors import DetectorUnavailable, DeviceLost, OutOfMemory


def edit(card_path, **fields) -> None:
    card_path.write_text(json.dumps({**json.loads(card_path.read_text()), **fields}))


def test_an_opened_model_scores_as_the_network_it_was_saved_from(model_store, network, card, pairs):
    opened = open_detector(model_store, "spicd-net/7", device="cpu")
    assert opened.card.version == "7"
    expected = SpicdNet(card, network, torch.device("cpu")).detect(Comparison.of_tiles(pairs))
    assert np.array_equal(
        opened.detect(Comparison.of_tiles(pairs)).probabilities, expected.probabilities, equal_nan=True
    )


def test_weights_that_are_not_the_cards_are_refused(model_store):
    weights = model_store / "spicd-net" / "7" / "weights.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(DetectorUnavailable, match="sha256"):
        open_detector(model_store, "spicd-net/7")


def test_a_card_without_a_hash_vouches_for_nothing(model_store):
    edit(model_store / "spicd-net" / "7" / "card.json", sha256=None)
    with pytest.raises(DetectorUnavailable, match="sha256"):
        open_detector(model_store, "spicd-net/7")


@pytest.mark.parametrize("name", ["spicd-net/8", "other/1"])
def test_an_unknown_model_is_named(model_store, name):
    with pytest.raises(DetectorUnavailable, match="no model at"):
        open_detector(model_store, name)


@pytest.mark.parametrize("name", ["spicd-net", "../spicd-net/7", "spicd-net/..", "/7", "a/b/c"])
def test_a_name_cannot_leave_the_store(model_store, name):
    with pytest.raises(DetectorUnavailable, match="name/version"):
        open_detector(model_store, name)


def test_an_unknown_detector_is_refused_with_those_there_are(model_store):
    edit(model_store / "spicd-net" / "7" / "card.json", detector="voxels")
    with pytest.raises(DetectorUnavailable, match=r"'voxels'.*spicd-net"):
        open_detector(model_store, "spicd-net/7")


def test_an_unsound_card_is_refused(model_store):
    edit(model_store / "spicd-net" / "7" / "card.json", threshold=3)
    with pytest.raises(DetectorUnavailable, match="threshold"):
        open_detector(model_store, "spicd-net/7")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_said(model_store):
    with pytest.raises(DetectorUnavailable, match="cuda"):
        open_detector(model_store, "spicd-net/7", device="cuda")


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"patch_points": 0}, r"detector_settings\.patch_points: Input should be greater than 0"),
        ({"patch_pints": 5}, r"detector_settings\.patch_pints: Extra inputs"),
        ({"chamfer_points": 4096}, r"the Chamfer sample takes 4096 of a patch's 1024 points"),
    ],
)
def test_a_setting_that_the_detector_does_not_take_is_refused_by_its_name(
    model_store, card, settings, reason
):
    edit(
        model_store / "spicd-net" / "7" / "card.json",
        detector_settings={**card.detector_settings, **settings},
    )
    with pytest.raises(DetectorUnavailable, match=rf"^model spicd-net/7: .*{reason}"):
        open_detector(model_store, "spicd-net/7", device="cpu")


def test_a_card_of_release_0_1_opens_with_its_settings_in_their_place(model_store, card, pairs):
    """It kept what SPICD-Net alone needs beside what the map is built with, in the store as in the database."""
    now = open_detector(model_store, "spicd-net/7", device="cpu").detect(Comparison.of_tiles(pairs))
    path = model_store / "spicd-net" / "7" / "card.json"
    written = json.loads(path.read_text())
    preprocessing = {**written["preprocessing"], **written.pop("detector_settings")}
    path.write_text(json.dumps({**written, "preprocessing": preprocessing}))
    opened = open_detector(model_store, "spicd-net/7", device="cpu")
    assert opened.card.preprocessing == card.preprocessing
    assert opened.card.detector_settings == card.detector_settings
    scores = opened.detect(Comparison.of_tiles(pairs)).probabilities
    assert np.array_equal(scores, now.probabilities, equal_nan=True)


def test_the_shipped_models_open():
    for name in ("spicd-net/1", "c2c/1"):
        assert open_detector(MODEL_STORE, name, device="cpu").card.model == name


def test_models_of_one_name_are_told_apart_by_their_weights_or_without_such_by_their_settings() -> None:
    weightless = open_card(MODEL_STORE, "c2c/1")
    other = weightless.model_copy(update={"detector_settings": {"half_distance": 0.1}})
    assert len(weightless.fingerprint) == 64
    assert weightless.fingerprint != other.fingerprint
    trained = open_card(MODEL_STORE, "spicd-net/1")
    assert trained.fingerprint == trained.sha256


def test_a_model_of_which_the_head_alone_was_trained_keeps_the_rest_in_its_base(
    model_store, network, card, pairs
):
    base = open_detector(model_store, "spicd-net/7", device="cpu")
    weights = {name: value.clone() for name, value in network.state_dict().items()}
    weights["head.classifier.6.bias"] += 1.0
    folder = write_model(
        model_store / "spicd-net" / "8", card.model_copy(update={"version": "8"}), weights, base=base
    )
    assert (folder / "weights.safetensors").stat().st_size < 1000
    opened = open_detector(model_store, "spicd-net/8", device="cpu")
    kept = weights_of(opened)
    assert kept.keys() == weights.keys()
    assert all(torch.equal(kept[name], value) for name, value in weights.items())
    with pytest.raises(ValueError, match="not whole by itself"):
        write_model(model_store / "spicd-net" / "9", card, weights, base=opened)


def test_a_model_whose_base_is_another_one_now_is_refused(model_store, network, card):
    base = open_detector(model_store, "spicd-net/7", device="cpu")
    eighth = card.model_copy(update={"version": "8"})
    write_model(model_store / "spicd-net" / "8", eighth, network.state_dict(), base=base)
    changed = {name: value + 1 for name, value in network.state_dict().items()}
    write_model(model_store / "spicd-net" / "7", base.card, changed)
    with pytest.raises(DetectorUnavailable, match="a part of spicd-net/7 with sha256"):
        open_detector(model_store, "spicd-net/8")


def test_a_model_stands_on_one_of_its_own_kind(model_store, network):
    base = open_detector(model_store, "spicd-net/7")
    other = base.card.model_copy(update={"name": "kpconv", "detector": "kpconv"})
    with pytest.raises(ValueError, match="a kpconv cannot stand on spicd-net/7, a spicd-net"):
        write_model(model_store / "kpconv" / "1", other, network.state_dict(), base=base)
    assert not (model_store / "kpconv").exists()


@pytest.mark.parametrize(
    ("error", "told", "sentence"),
    [
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
            OutOfMemory,
            "more of the GPU's",
        ),
        (torch.AcceleratorError("CUDA error: out of memory\nmore"), OutOfMemory, "more of the GPU's"),
        (
            RuntimeError("CUDA error: unspecified launch failure\nmore"),
            DeviceLost,
            "unspecified launch failure$",
        ),
        (RuntimeError("size mismatch"), DetectorUnavailable, "size mismatch"),
    ],
)
def test_what_the_device_says_of_itself_is_not_said_of_the_model(
    model_store, monkeypatch, error, told, sentence
):
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(SpicdNet, "run_with", fails)
    with pytest.raises(told, match=f"model spicd-net/7.*{sentence}"):
        open_detector(model_store, "spicd-net/7", "cpu", Runtime())


def test_what_cuda_refuses_while_it_computes_on_is_said_of_the_model(model_store, monkeypatch):
    def fails(*_: object) -> None:
        raise RuntimeError("CUDA error: no kernel image is available for execution on the device\nmore")

    monkeypatch.setattr(SpicdNet, "run_with", fails)
    monkeypatch.setattr("worker.detectors.store.device_answers", lambda: True)
    with pytest.raises(
        DetectorUnavailable, match=r"no kernel image is available for execution on the device$"
    ):
        open_detector(model_store, "spicd-net/7", "cpu", Runtime())
