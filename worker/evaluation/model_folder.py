"""Writes what `worker.detectors.store` opens: a card, and the weights that it vouches for."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from safetensors.torch import save

from worker.detectors.card import Card
from worker.detectors.store import Weights

WEIGHTS = "weights.safetensors"


def write_model(folder: Path, card: Card, weights: Weights) -> Path:
    """The weights before the card, whose `sha256` is put in here; returns the folder."""
    content = weights_content(weights)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / WEIGHTS).write_bytes(content)
    write_card(folder, card.model_copy(update={"sha256": hashlib.sha256(content).hexdigest()}))
    return folder


def write_card(folder: Path, card: Card) -> None:
    """`card.json`, aside and renamed. Raises ValueError for a figure that JSON has not, such as NaN."""
    text = json.dumps(card.model_dump(mode="json"), indent=2, allow_nan=False)
    aside = folder / "card.json.tmp"
    aside.write_text(text + "\n", encoding="utf-8")
    aside.replace(folder / "card.json")


def weights_content(weights: Weights) -> bytes:
    """As safetensors; the same weights, the same bytes."""
    content: bytes = save({name: tensor.contiguous() for name, tensor in weights.items()})
    return content


def sha256_of(weights: Weights) -> str:
    """What the card of a model with these weights says."""
    return hashlib.sha256(weights_content(weights)).hexdigest()
