"""Trains the voxel network on crops of samples; can be stopped and taken up again at the last epoch's end."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from worker.cloud.settings import StrictModel
from worker.cloud.voxel_keys import Keys, packed, unpacked
from worker.detectors.voxel_net.detector import BLIND, SEEING, VoxelNetSettings
from worker.detectors.voxel_net.network import VoxelNetwork, probabilities
from worker.detectors.voxel_net.sparse import pyramid
from worker.files import write_atomically
from worker.metrics import precision_recall
from worker.progress import Progress, no_progress
from worker.training.voxels.samples import MISSING, UNKNOWN, VoxelSample

CPU = torch.device("cpu")
LOG, CHECKPOINT, BEST = "epochs-{}.csv", "last-{}.pt", "best-{}.pt"  #: by the network's name
_APART = 256  # voxels between two crops of a batch


class VoxelTrainSettings(StrictModel):
    """How a network is trained."""

    epochs: int = Field(20, ge=1)
    steps: int = Field(100, ge=1, description="of an epoch")
    crops: int = Field(6, ge=1, description="of a step")
    crop: int = Field(64, ge=8, description="voxels along x and y of a crop, which takes all heights")
    around_change: float = Field(0.6, ge=0, le=1, description="share of the crops around something missing")
    learning_rate: float = Field(3e-3, gt=0, description="falls to a hundredth by a cosine")
    weight_decay: float = Field(1e-3, ge=0)
    dice: float = Field(0.3, ge=0, description="weight of the soft Dice loss beside cross-entropy")
    minutes: float | None = Field(None, gt=0, description="at most; the rate falls by whichever ends first")
    held_out: int = Field(8, ge=2, description="every so many-th building is validated on")
    seed: int = 42
    detector: VoxelNetSettings = VoxelNetSettings.model_validate({})


@dataclass(frozen=True, kw_only=True, slots=True)
class VoxelEpoch:
    """One line of the log."""

    epoch: int
    seconds: float
    learning_rate: float
    train_loss: float
    validation_loss: float
    average_precision: float  #: over the voxels of the validation buildings


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Crop:
    cells: NDArray[np.int64]  #: (n, 3)
    channels: NDArray[np.float16]  #: (n, 12)
    labels: NDArray[np.int8]  #: (n,)


class _Crops:
    """Draws crops of samples, a sample as often as its voxels are many."""

    def __init__(self, samples: Sequence[VoxelSample], settings: VoxelTrainSettings) -> None:
        self._samples, self._settings = samples, settings
        self._cells = [unpacked(sample.keys).astype(np.int32) for sample in samples]
        self._missing = [np.flatnonzero(sample.labels == MISSING) for sample in samples]
        changed = np.array([len(rows) for rows in self._missing], np.float64) ** 0.5
        known = np.array([(sample.labels != UNKNOWN).sum() for sample in samples], np.float64) ** 0.5
        self._weights = changed / changed.sum(), known / known.sum()

    def batch(self, rng: np.random.Generator) -> tuple[Keys, NDArray[np.float32], NDArray[np.int8]]:
        """Return keys (N,) ascending, channels (N, 12) and labels (N,) of several crops, side by side."""
        crops = [self._crop(rng) for _ in range(self._settings.crops)]
        cells, shift = [], 0
        for crop in crops:
            cells.append(crop.cells + np.array([shift, 0, 0]))
            shift += 2 * self._settings.crop + _APART
        keys = packed(np.concatenate(cells))
        order = np.argsort(keys)
        channels = np.concatenate([crop.channels for crop in crops])[order].astype(np.float32)
        return keys[order], channels, np.concatenate([crop.labels for crop in crops])[order]

    def _crop(self, rng: np.random.Generator) -> _Crop:
        """Cut a column, turn it by quarters, mirror it, and shift it against the coarser cells."""
        around = bool(rng.random() < self._settings.around_change)
        number = int(rng.choice(len(self._samples), p=self._weights[0 if around else 1]))
        sample, cells = self._samples[number], self._cells[number]
        rows = self._missing[number] if around else np.flatnonzero(sample.labels != UNKNOWN)
        half = self._settings.crop // 2
        middle = cells[rows[rng.integers(len(rows))], :2] + rng.integers(-half // 2, half // 2 + 1, 2)
        near = np.flatnonzero((np.abs(cells[:, :2] - middle) < half).all(axis=1))
        placed = cells[near].astype(np.int64) - [*middle, cells[near, 2].min()]
        for _ in range(int(rng.integers(4))):
            placed = np.stack([-1 - placed[:, 1], placed[:, 0], placed[:, 2]], axis=1)
        if rng.random() < 0.5:
            placed[:, 0] = -1 - placed[:, 0]
        placed += rng.integers(0, 8, 3)
        return _Crop(cells=placed, channels=sample.channels[near], labels=sample.labels[near])


def train_network(
    name: str,
    samples: Sequence[VoxelSample],
    settings: VoxelTrainSettings,
    out: Path,
    progress: Progress = no_progress,
    *,
    start: Mapping[str, Tensor] | None = None,
    on_epoch: Callable[[Path], None] | None = None,
) -> Path:
    """Train the network for free space or the one without, on those samples; returns the best checkpoint.

    A folder with a checkpoint of the same settings is taken up where it stopped. `start` are the weights to begin
    with; `on_epoch` is called with the folder once an epoch's files are complete. Raises ValueError for a checkpoint
    of others or where no sample is of the kind, FloatingPointError where the loss is no number.
    """
    fitting = [sample for sample in samples if sample.free_space == (name == SEEING)]
    training = [sample for sample in fitting if sample.building % settings.held_out and _useful(sample)]
    validation = [sample for sample in fitting if sample.building % settings.held_out == 0]
    if not training or not validation:
        raise ValueError(f"{len(training)} samples to train {name} on and {len(validation)} to validate on")
    out.mkdir(parents=True, exist_ok=True)
    run = _Run(name, settings, out, start)
    run.resume()
    crops = _Crops(training, settings)
    while not run.finished:
        run.epoch(crops, validation, progress)
        if on_epoch is not None:
            on_epoch(out)
    progress(f"train {name}", 1.0)
    return out / BEST.format(name)


def train_networks(
    samples: Sequence[VoxelSample],
    settings: VoxelTrainSettings,
    blind: VoxelTrainSettings,
    out: Path,
    progress: Progress = no_progress,
) -> dict[str, Path]:
    """Train both networks of a model; returns the checkpoint of each. Raises as `train_network` does."""
    return {
        name: train_network(name, samples, asked, out, progress)
        for name, asked in ((SEEING, settings), (BLIND, blind))
    }


class _Run:
    """The state of one training."""

    def __init__(
        self, name: str, settings: VoxelTrainSettings, out: Path, start: Mapping[str, Tensor] | None
    ) -> None:
        torch.manual_seed(settings.seed)
        self._name, self._settings, self._out = name, settings, out
        self._network: VoxelNetwork = settings.detector.build()
        if start is not None:
            self._network.load_state_dict(start)
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.epochs, self._seconds, self._best = 0, 0.0, -1.0

    @property
    def finished(self) -> bool:
        """The epochs or the time are spent."""
        return self._done(self.epochs, self._seconds) >= 1

    def _done(self, epochs: float, seconds: float) -> float:
        minutes = self._settings.minutes
        return max(epochs / self._settings.epochs, 0 if minutes is None else seconds / 60 / minutes)

    def resume(self) -> None:
        """Take up the last checkpoint, if the folder has one. Raises ValueError for one of other settings."""
        path = self._out / CHECKPOINT.format(self._name)
        if not path.exists():
            return
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["settings"] != self._settings.model_dump(mode="json"):
            raise ValueError(f"{path} was made with other settings; use them, or another folder")
        self._network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.epochs, self._seconds, self._best = state["epochs"], state["seconds"], state["best"]

    def epoch(self, crops: _Crops, validation: Sequence[VoxelSample], progress: Progress) -> None:
        """Take an epoch's steps, validate, and keep checkpoints and the log."""
        began, settings = time.monotonic(), self._settings
        rng = np.random.default_rng((settings.seed, self.epochs))
        losses = []
        self._network.train()
        for step in range(settings.steps):
            seconds = self._seconds + time.monotonic() - began
            done = self._done(self.epochs + step / settings.steps, seconds)
            if done >= 1:
                break
            progress(f"train {self._name}", done)
            losses.append(self._step(crops.batch(rng), rate=_cosine(settings.learning_rate, done)))
        if not np.isfinite(losses).all():
            raise FloatingPointError(
                f"epoch {self.epochs + 1}: the loss is no number; lower the learning rate"
            )
        loss, precision = validated(self._network, validation)
        self.epochs += 1
        self._seconds += time.monotonic() - began
        row = VoxelEpoch(
            epoch=self.epochs,
            seconds=round(self._seconds, 1),
            learning_rate=_cosine(settings.learning_rate, self._done(self.epochs, self._seconds)),
            train_loss=float(np.mean(losses)) if losses else 0.0,
            validation_loss=loss,
            average_precision=precision,
        )
        if precision > self._best:
            self._best = precision
            self._save(BEST, asdict(row))
        self._save(CHECKPOINT, asdict(row))
        self._log(row)

    def _step(self, batch: tuple[Keys, NDArray[np.float32], NDArray[np.int8]], *, rate: float) -> float:
        keys, channels, labels = batch
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        logits = self._network(torch.from_numpy(channels), pyramid(keys, self._network.levels))
        loss = voxel_loss(logits, torch.from_numpy(labels), dice=self._settings.dice)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._network.parameters(), 1.0)
        self._optimizer.step()
        return float(loss.detach())

    def _save(self, name: str, row: dict[str, Any]) -> None:
        state = {
            "settings": self._settings.model_dump(mode="json"),
            "network": self._network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "epochs": self.epochs,
            "seconds": self._seconds,
            "best": self._best,
            "measured": row,
        }
        write_atomically(self._out / name.format(self._name), partial(torch.save, state))

    def _log(self, row: VoxelEpoch) -> None:
        path = self._out / LOG.format(self._name)
        fresh = row.epoch == 1 or not path.exists()
        with path.open("w" if fresh else "a", newline="") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(VoxelEpoch)])
            if fresh:
                writer.writeheader()
            writer.writerow(asdict(row))


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read what a training kept: settings, network, seconds, and what was measured. Raises OSError."""
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    return state


def voxel_loss(logits: Tensor, labels: Tensor, *, dice: float) -> Tensor:
    """Return binary cross-entropy over the voxels (N,) whose truth is known, and the soft Dice loss by its weight."""
    known = labels != UNKNOWN
    logits, truth = logits[known], (labels[known] == MISSING).to(logits.dtype)
    entropy = nn.functional.binary_cross_entropy_with_logits(logits, truth)
    p = torch.sigmoid(logits)
    overlap = (2 * (p * truth).sum() + 1) / (p.sum() + truth.sum() + 1)
    return entropy + dice * (1 - overlap)


def validated(network: VoxelNetwork, samples: Sequence[VoxelSample]) -> tuple[float, float]:
    """Return cross-entropy and average precision over the voxels of whole samples whose truth is known."""
    network.eval()
    scores, truth = [], []
    for sample in samples:
        known = sample.labels != UNKNOWN
        told = probabilities(network, sample.keys, sample.channels.astype(np.float32), CPU)
        scores.append(told[known])
        truth.append(sample.labels[known] == MISSING)
    p, missing = np.concatenate(scores).astype(np.float64), np.concatenate(truth)
    wrong = np.where(missing, 1 - p, p)
    return float(-np.log(np.maximum(1 - wrong, 1e-7)).mean()), precision_recall(p, missing).average_precision


def _useful(sample: VoxelSample) -> bool:
    return bool((sample.labels == MISSING).any() and (sample.labels == 0).any())


def _cosine(rate: float, done: float) -> float:
    return rate * (0.01 + 0.99 * (1 + float(np.cos(np.pi * min(done, 1.0)))) / 2)
