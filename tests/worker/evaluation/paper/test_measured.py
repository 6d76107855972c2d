"""A checkpoint of training is measured under the card of a model."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from worker.detectors.card import MODEL_STORE
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.store import open_card
from worker.errors import DetectorUnavailable
from worker.evaluation.paper.measured import open_measured


def test_a_checkpoint_brings_its_weights_patch_size_and_seed(tmp_path: Path) -> None:
    settings = {"seed": 7, "pairs": {"patch_points": 1024}}
    torch.save({"settings": settings, "network": SpicdNetwork().state_dict()}, tmp_path / "fresh.pt")
    card = open_measured(MODEL_STORE, "spicd-net/1", tmp_path / "fresh.pt").card
    shipped = open_card(MODEL_STORE, "spicd-net/1")
    assert (card.preprocessing.patch_points, card.preprocessing.seed) == (1024, 7)
    assert (card.name, card.version) == ("spicd-net", "fresh")
    assert card.preprocessing.tile_size == shipped.preprocessing.tile_size
    assert card.threshold == shipped.threshold


@pytest.mark.parametrize("content", [b"no archive at all", None])
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "odd.pt"
    if content is None:
        torch.save({"network": {}}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(DetectorUnavailable, match=r"odd\.pt is no checkpoint"):
        open_measured(MODEL_STORE, "spicd-net/1", path)
