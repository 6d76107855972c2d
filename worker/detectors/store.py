"""The models of `model_store/`: opened and written, a card with weights that match it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal, Protocol, runtime_checkable

import pydantic
import torch
from pydantic import BaseModel
from safetensors import SafetensorError
from safetensors.torch import load, save

from worker.detectors.card import BaseRecord, Card
from worker.detectors.detector import Detector
from worker.detectors.registry import DETECTORS
from worker.detectors.running.calls import device_answers, is_full_memory
from worker.detectors.running.runtime import RunsNetwork, Runtime
from worker.errors import DetectorUnavailable, DeviceLost, OutOfMemory, TrainingFailed
from worker.files import write_text

Device = Literal["auto", "cpu", "cuda"]
Weights = dict[str, torch.Tensor]


class DetectorClass(Protocol):
    """How a detector is opened."""

    @property
    def settings_class(self) -> type[BaseModel]:
        """Of the card's `detector_settings`."""

    def load(self, card: Card, weights: Weights, device: torch.device) -> Detector:
        """Open a model. Raises RuntimeError for weights of another network, ValueError for unsound settings."""


@runtime_checkable
class TrainedDetector(Detector, Protocol):
    """A detector that has weights."""

    def weights(self) -> Weights:
        """Return what `load` takes."""


def detector_class(key: str) -> DetectorClass:
    """Return what opens the models of the detector of this key. Raises KeyError."""
    opens: DetectorClass = resolve_name(DETECTORS[key].detector)
    return opens


def open_detector(
    model_store: Path,
    name: str = "voxel-net/1",
    device: Device = "auto",
    runtime: Runtime | None = None,
) -> Detector:
    """Return the detector `<name>/<version>`, ready to score.

    Raises DetectorUnavailable when there is no such model, its card is unsound, its weights are not those of
    the card, or the device is not there; OutOfMemory when the device has no room for it, DeviceLost when it fails.
    """
    card = open_card(model_store, name)
    content = _weights_file(_folder(model_store, name), card)
    return make_detector(card, content, device, runtime, base=_base_weights(model_store, card))


def make_detector(
    card: Card,
    content: bytes | None,
    device: Device = "auto",
    runtime: Runtime | None = None,
    *,
    base: Weights | None = None,
) -> Detector:
    """Return the detector of a card and the bytes of its weights file (None: none).

    `runtime` is what its network is run by; by default in the thread that asks, in float32. `base` are the weights of
    the model that the card names as its base, if any. Raises DetectorUnavailable, OutOfMemory when the device has no
    room for it, and DeviceLost when the device fails.
    """
    name = card.model
    if card.detector not in DETECTORS:
        raise DetectorUnavailable(
            f"model {name}: no detector {card.detector!r}; there are {sorted(DETECTORS)}"
        )
    weights = {} if content is None else _checked_weights(name, card, content)
    merged, lost = {**(base or {}), **weights}, ""
    try:
        return _placed(card, merged, resolve_device(device), runtime)
    except (RuntimeError, ValueError) as error:
        if not is_full_memory(error):
            if not DeviceLost.is_told_by(error):
                raise DetectorUnavailable(f"model {name}: {error}") from error
            lost = str(error).partition("\n")[0]
    # only here, for the error holds on to what was placed of the model
    if lost:
        if device_answers():
            raise DetectorUnavailable(f"model {name}: {lost}")
        raise DeviceLost(f"the device of model {name} fails: {lost}")
    raise OutOfMemory(
        f"model {name} needs more of the GPU's memory than is free; "
        "raise SPICD_INFERENCE_GPU_SHARE, or end what else runs there"
    )


def _placed(card: Card, weights: Weights, device: torch.device, runtime: Runtime | None) -> Detector:
    """Return the detector on its device. Raises RuntimeError or ValueError, by what is unsound or does not suffice."""
    detector = detector_class(card.detector).load(card, weights, device)
    if runtime is not None and isinstance(detector, RunsNetwork):
        detector.run_with(runtime)
    return detector


def settings_of(card: Card) -> dict[str, Any]:
    """Return the detector's own settings with every default. Raises ValueError, which names each unsound field."""
    return card.settings_as(detector_class(card.detector).settings_class).model_dump()


def open_card(model_store: Path, name: str) -> Card:
    """Return the card of `<name>/<version>` without its weights. Raises DetectorUnavailable."""
    return read_card(_folder(model_store, name))


def read_card(folder: Path) -> Card:
    """Return the card in a model's folder. Raises DetectorUnavailable."""
    path = folder / "card.json"
    try:
        return Card.model_validate_json(path.read_bytes())
    except OSError as missing:
        raise DetectorUnavailable(f"no model at {folder}: {missing.strerror}") from missing
    except pydantic.ValidationError as unsound:
        raise DetectorUnavailable(
            f"{path}: {unsound.error_count()} fields are unsound: {unsound}"
        ) from unsound


def resolve_device(device: Device) -> torch.device:
    """Return the device to run on; `auto` is the GPU when there is one. Raises DetectorUnavailable."""
    if device == "cuda" and not torch.cuda.is_available():
        raise DetectorUnavailable("device cuda is asked for, but torch finds no CUDA GPU; use auto or cpu")
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(device)


def _folder(model_store: Path, name: str) -> Path:
    parts = name.split("/")
    if len(parts) != 2 or any(part in ("", ".", "..") or "\\" in part for part in parts):
        raise DetectorUnavailable(f"model {name!r} is not of the form name/version")
    return model_store / parts[0] / parts[1]


def _weights_file(folder: Path, card: Card) -> bytes | None:
    """Return the weights named by the card, read once so that what is hashed is what is loaded."""
    if card.weights is None:
        return None
    path = folder / card.weights
    try:
        return path.read_bytes()
    except OSError as missing:
        raise DetectorUnavailable(f"no weights at {path}: {missing.strerror}") from missing


def _base_weights(model_store: Path, card: Card) -> Weights:
    """Return the weights of the model that this one is a part of, none where it is whole. Raises DetectorUnavailable."""
    if card.base is None:
        return {}
    folder = _folder(model_store, card.base.model)
    base = read_card(folder)
    content = _weights_file(folder, base)
    if content is None or base.sha256 != card.base.sha256:
        raise DetectorUnavailable(
            f"model {card.model} is a part of {card.base.model} with sha256 {card.base.sha256}, not {base.sha256}"
        )
    return _checked_weights(card.base.model, base, content)


def _checked_weights(name: str, card: Card, content: bytes) -> Weights:
    digest = hashlib.sha256(content).hexdigest()
    if digest != card.sha256:
        raise DetectorUnavailable(f"the weights of {name} have sha256 {digest}, its card says {card.sha256}")
    try:
        weights: Weights = load(content)
    except SafetensorError as unsound:
        raise DetectorUnavailable(f"the weights of {name} are no safetensors file: {unsound}") from unsound
    return weights


WEIGHTS = "weights.safetensors"


def write_model(folder: Path, card: Card, weights: Weights, *, base: Detector | None = None) -> Path:
    """Write the weights before the card, whose `sha256` is put in here; returns the folder.

    With `base`, a whole model of the same store, weights that are equal to its own are left out of the file. Raises
    ValueError for a base of another detector, and as `_record`.
    """
    if base is not None:
        if base.card.detector != card.detector:
            raise ValueError(f"a {card.detector} cannot stand on {base.card.model}, a {base.card.detector}")
        card = card.model_copy(update={"base": _record(base)})
        known = weights_of(base)
        weights = {name: value for name, value in weights.items() if not _equal(value, known.get(name))}
    content = weights_content(weights)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / WEIGHTS).write_bytes(content)
    write_card(folder, card.model_copy(update={"sha256": hashlib.sha256(content).hexdigest()}))
    return folder


def _record(base: Detector) -> BaseRecord:
    """Name a model to stand on. Raises ValueError for one without weights, or that itself stands on another."""
    if base.card.sha256 is None or base.card.base is not None:
        raise ValueError(f"model {base.card.model} is not whole by itself: no other can stand on it")
    return BaseRecord(model=base.card.model, sha256=base.card.sha256)


def _equal(value: torch.Tensor, other: torch.Tensor | None) -> bool:
    return other is not None and torch.equal(value.cpu(), other.cpu())


def write_card(folder: Path, card: Card) -> None:
    """Write `card.json`. Raises ValueError for a figure that JSON has not, such as NaN."""
    text = json.dumps(card.model_dump(mode="json"), indent=2, allow_nan=False)
    write_text(folder / "card.json", text + "\n")


def weights_content(weights: Weights) -> bytes:
    """Return the weights as safetensors; the same weights, the same bytes."""
    content: bytes = save({name: tensor.contiguous() for name, tensor in weights.items()})
    return content


def weights_of(detector: Detector) -> Weights:
    """Return the weights of a detector, to train further from. Raises TrainingFailed where it has none."""
    if not isinstance(detector, TrainedDetector):
        raise TrainingFailed(
            f"model {detector.card.model} cannot be trained further: detector {detector.card.detector!r} has no weights"
        )
    return detector.weights()


def sha256_of(weights: Weights) -> str:
    """Return what the card of a model with these weights says."""
    return hashlib.sha256(weights_content(weights)).hexdigest()
