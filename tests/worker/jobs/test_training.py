"""What a site's training takes over from the model that it goes on from."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from worker.detectors.card import MODEL_STORE
from worker.detectors.registry import trainable_detectors
from worker.detectors.store import open_card, open_detector, weights_of
from worker.jobs import training as module

SHIPPED = sorted(
    "/".join(card.parts[-3:-1])
    for card in MODEL_STORE.glob("*/*/card.json")
    if open_card(MODEL_STORE, "/".join(card.parts[-3:-1])).detector in trainable_detectors()
)


@pytest.fixture(autouse=True)
def no_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "load_tiles", lambda path: None)
    monkeypatch.setattr(module, "held_out_share", lambda tiles, *, min_separation: 0.2)


def settings_for(model: str, base: str | None) -> Any:
    card = open_card(MODEL_STORE, model)
    asked: Any = SimpleNamespace(
        model=SimpleNamespace(base=base, epochs=None, minutes=1.0), card=card, detector=card.detector
    )
    context: Any = SimpleNamespace(settings=SimpleNamespace(device="cpu"))
    return module._settings(context, asked, Path("tiles.npz"))


@pytest.mark.parametrize("model", SHIPPED)
def test_every_shipped_model_can_be_trained_further(model: str) -> None:
    network = settings_for(model, model).network
    fresh = network.build()
    network.start_from(fresh, weights_of(open_detector(MODEL_STORE, model, "cpu")), fresh_head=False)


@pytest.mark.parametrize("model", SHIPPED)
def test_a_model_from_nothing_is_given_what_the_maps_model_is_given(model: str) -> None:
    own = open_card(MODEL_STORE, model).detector_settings
    network = settings_for(model, None).network
    assert (network.counts, network.patch_points) == (own.get("counts", False), own["patch_points"])


def test_weights_of_another_network_are_an_error_that_says_so() -> None:
    network = settings_for("spicd-net/1", None).network
    with pytest.raises(ValueError, match="what it starts from is another network"):
        network.start_from(
            network.build(), weights_of(open_detector(MODEL_STORE, "spicd-net/2", "cpu")), fresh_head=False
        )


def test_the_shipped_models_are_those_that_one_thinks_of() -> None:
    assert {"spicd-net/1", "spicd-net/2", "pointnet2/1", "kpconv/1"} <= set(SHIPPED)
