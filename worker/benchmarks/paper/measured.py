"""The detector that is measured: a model of the store, or a checkpoint that has not become one yet; and its training's log."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch

from worker.benchmarks.plots import Log, read_log
from worker.detectors.detector import Detector
from worker.detectors.store import DETECTORS, open_card, open_detector, resolve_device, sha256_of
from worker.errors import DetectorUnavailable
from worker.training.log import LOG
from worker.training.settings import detector_settings


def open_measured(model_store: Path, model: str, weights: Path | None) -> Detector:
    """The model, or with `weights` the network of a checkpoint of `worker.training`, under the model's card.

    A checkpoint brings its own patch size and seed, and the sha256 that its weights will have in a model. Raises DetectorUnavailable.
    """
    if weights is None:
        return open_detector(model_store, model)
    card = open_card(model_store, model)
    try:
        state = torch.load(weights, map_location="cpu", weights_only=True)
        update = {
            "version": weights.stem,
            "detector_settings": detector_settings(state["settings"]),
            "sha256": sha256_of(state["network"]),
        }
        card = card.model_copy(update=update)
        return DETECTORS[card.detector].load(card, state["network"], resolve_device("auto"))
    except OSError as missing:
        raise DetectorUnavailable(f"no checkpoint at {weights}: {missing.strerror}") from missing
    except (AttributeError, KeyError, TypeError, EOFError, RuntimeError, pickle.UnpicklingError) as unsound:
        raise DetectorUnavailable(f"{weights} is no checkpoint of spicd-worker train: {unsound}") from unsound


def training_log(model_store: Path, model: str, weights: Path | None) -> Log | None:
    """The log that lies beside the model's card, or beside the checkpoint; None where there is none.

    Raises ValueError for a file that is none.
    """
    path = (model_store / model if weights is None else weights.parent) / LOG
    return (read_log(path) or None) if path.exists() else None
