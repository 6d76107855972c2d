"""A checkpoint of training is measured under the card of a model."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest
import torch

from worker.benchmarks.paper.measured import open_measured, training_log
from worker.detectors.card import MODEL_STORE
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.store import WEIGHTS, open_card, read_card, write_model
from worker.errors import DetectorUnavailable
from worker.training.log import LOG


def test_a_checkpoint_brings_its_weights_patch_size_and_seed(tmp_path: Path) -> None:
    settings = {"seed": 7, "pairs": {"patch_points": 1024}}
    torch.save({"settings": settings, "network": SpicdNetwork().state_dict()}, tmp_path / "fresh.pt")
    card = open_measured(MODEL_STORE, "spicd-net/1", tmp_path / "fresh.pt").card
    shipped = open_card(MODEL_STORE, "spicd-net/1")
    assert card.detector_settings == {"patch_points": 1024, "chamfer_points": 128, "seed": 7}
    assert (card.name, card.version) == ("spicd-net", "fresh")
    assert card.preprocessing.tile_size == shipped.preprocessing.tile_size
    assert card.threshold == shipped.threshold
    assert card.sha256 != shipped.sha256


def test_a_checkpoint_has_the_sha256_of_the_model_that_is_made_of_it(tmp_path: Path) -> None:
    weights = SpicdNetwork().state_dict()
    settings = {"seed": 7, "pairs": {"patch_points": 1024}}
    torch.save({"settings": settings, "network": weights}, tmp_path / "fresh.pt")
    measured = open_measured(MODEL_STORE, "spicd-net/1", tmp_path / "fresh.pt").card
    made = write_model(tmp_path / "model", measured, weights)
    assert measured.sha256 == hashlib.sha256((made / WEIGHTS).read_bytes()).hexdigest()
    assert read_card(made) == measured


SOUND = {"seed": 7, "pairs": {"patch_points": 1024}}


@pytest.mark.parametrize(
    "content", [b"no archive at all", {"network": {}}, {"network": {"layer": 1}, "settings": SOUND}]
)
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes | dict[str, Any]) -> None:
    path = tmp_path / "odd.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(DetectorUnavailable, match=r"odd\.pt is no checkpoint"):
        open_measured(MODEL_STORE, "spicd-net/1", path)


def test_the_log_is_that_beside_the_model_or_beside_the_checkpoint(tmp_path: Path) -> None:
    model, run = tmp_path / "spicd-net" / "7", tmp_path / "run"
    for folder, loss in ((model, 0.5), (run, 0.25)):
        folder.mkdir(parents=True)
        (folder / LOG).write_text(f"epoch,train_loss\n1,{loss}\n")
    assert training_log(tmp_path, "spicd-net/7", None) == [{"epoch": 1, "train_loss": 0.5}]
    assert training_log(tmp_path, "spicd-net/7", run / "best.pt") == [{"epoch": 1, "train_loss": 0.25}]


@pytest.mark.parametrize("text", [None, "epoch,train_loss\n"])
def test_without_a_log_or_an_epoch_in_it_there_is_none(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / LOG).write_text(text)
    assert training_log(tmp_path, "spicd-net/7", tmp_path / "best.pt") is None
