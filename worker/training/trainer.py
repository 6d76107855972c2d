"""Trains SPICD-Net (paper, Section 3.8) and can be stopped and taken up again."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from worker.detectors.spicd_net.chamfer import chamfer_statistics
from worker.detectors.spicd_net.layers import PooledLinear
from worker.detectors.spicd_net.network import PairOutput, SpicdNetwork
from worker.progress import Progress, silent
from worker.training.dataset import TileSet, load_tiles, split_tiles
from worker.training.losses import total_loss
from worker.training.metrics import Measured, measured
from worker.training.pairs import PAPER_PAIRS, Batch, PairMaker, PairSettings
from worker.training.prefetch import prefetched
from worker.training.schedule import Schedule

SETTLING_PAIRS = 128  #: that the head is initialised by
CHECKPOINT, BEST, LOG = "last.pt", "best.pt", "epochs.csv"


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainSettings:
    """The paper's values, but for `minutes`."""

    epochs: int = 1000
    minutes: float | None = None  #: wall clock of the whole run, resumed parts included; None: epochs alone
    patience: int = 100  #: epochs without a better checkpoint
    batch: int = 16  #: pairs
    train_pairs: int = 2000  #: an epoch
    validation_pairs: int = 500
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-5
    weight_decay: float = 1e-4
    held_out: float = 0.1  #: share of the tiles
    seed: int = 42
    start_from: str | None = (
        None  #: what network is trained on, with a fresh optimiser: a checkpoint, or as said with `start`
    )
    settle_head: bool = True  #: ours: the head's first layers start as if their inputs were standardised
    device: str = "cpu"
    coarse_search: bool = (
        True  #: bfloat16 where max-pooling looks for its winners; a third less time on the CPU
    )
    pairs: PairSettings = field(default_factory=PairSettings)

    @property
    def schedule(self) -> Schedule:
        return Schedule(
            epochs=self.epochs,
            minutes=self.minutes,
            start=self.learning_rate,
            end=self.final_learning_rate,
        )


#: Sections 3.5 to 3.8 to the letter.
PAPER = TrainSettings(pairs=PAPER_PAIRS, settle_head=False)


@dataclass(frozen=True, kw_only=True, slots=True)
class EpochRow:
    """One line of the log."""

    epoch: int
    seconds: float  #: since the run began, stops left out
    learning_rate: float  #: at the epoch's end
    train_loss: float
    train_accuracy: float  #: of the network as it was at each step, dropout included
    validation_loss: float
    accuracy: float  #: on the validation pairs
    precision_unchanged: float
    precision_changed: float
    precision_different: float
    recall_unchanged: float
    recall_changed: float
    recall_different: float


def train(
    settings: TrainSettings,
    dataset: Path,
    out: Path,
    progress: Progress = silent,
    *,
    start: Mapping[str, Tensor] | None = None,
    on_epoch: Callable[[Path], None] | None = None,
) -> Path:
    """Train on the tiles of `dataset`, keeping everything in the folder `out`; returns the best checkpoint.

    A folder that already holds a checkpoint of the same settings and data is taken up where it stopped.
    `start` is the network that `start_from` names, where that is no checkpoint. `on_epoch` is called with the
    folder once an epoch's files are complete. Raises ValueError for a checkpoint of others, FloatingPointError when
    the loss is no longer a number.
    """
    out.mkdir(parents=True, exist_ok=True)
    training, validation = split_tiles(load_tiles(dataset), share=settings.held_out)
    run = Run(settings, training, validation, out, start=start)
    run.resume()
    while not run.finished:
        run.epoch(progress)
        if on_epoch is not None:
            on_epoch(out)
    progress("train", 1.0)
    return out / BEST


class Run:
    """The state of one training."""

    def __init__(
        self,
        settings: TrainSettings,
        training: TileSet,
        validation: TileSet,
        out: Path,
        *,
        start: Mapping[str, Tensor] | None = None,
    ) -> None:
        torch.manual_seed(settings.seed)
        self._settings = settings
        self._out = out
        self._device = torch.device(settings.device)
        self._network = SpicdNetwork().to(self._device)
        for module in self._network.modules():
            if isinstance(module, PooledLinear):
                module.coarse_search = settings.coarse_search
        self._optimizer = torch.optim.Adam(
            self._network.parameters(),
            lr=settings.learning_rate,
            weight_decay=settings.weight_decay,
            fused=True,
        )
        self._makers = PairMaker(training, settings.pairs), PairMaker(validation, settings.pairs)
        if start is None and settings.start_from is not None:
            start = torch.load(settings.start_from, map_location=self._device, weights_only=True)["network"]
        if start is not None:
            self._network.load_state_dict(start)
        elif settings.settle_head:
            self._settle()
        self._epochs = 0
        self._seconds = 0.0
        self._best = (-1.0, -1.0)
        self._best_epoch = 0

    @property
    def finished(self) -> bool:
        """The epochs or the time are spent, or nothing has become better for long."""
        stale = self._epochs - self._best_epoch >= self._settings.patience
        return stale or self._settings.schedule.done(self._epochs, self._seconds) >= 1.0

    def epoch(self, progress: Progress) -> EpochRow:
        """Train on one epoch's pairs, validate, and keep both checkpoints and the log."""
        began = time.monotonic() - self._seconds
        trained = self._train_pass(began, progress)
        found = self._validate(began, progress)
        self._epochs += 1
        self._seconds = time.monotonic() - began
        if found.rank > self._best:
            self._best, self._best_epoch = found.rank, self._epochs
            self._save(BEST, {"measured": asdict(found)})
        row = self._log(trained, found)
        self._save(
            CHECKPOINT, {"optimizer": self._optimizer.state_dict(), "torch_rng": torch.get_rng_state()}
        )
        return row

    def resume(self) -> None:
        """Take up the last checkpoint, if the folder has one."""
        path = self._out / CHECKPOINT
        if not path.exists():
            return
        state = torch.load(path, map_location=self._device, weights_only=True)
        if _whole(state["settings"]) != asdict(self._settings):
            raise ValueError(f"{path} was made with other settings; use them, or another folder")
        self._network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        torch.set_rng_state(state["torch_rng"].cpu())
        self._epochs, self._seconds = state["epochs"], state["seconds"]
        self._best, self._best_epoch = tuple(state["best"]), state["best_epoch"]
        self._cut_log()

    def _train_pass(self, began: float, progress: Progress) -> _Trained:
        """One epoch's steps. Ends early when the time is up."""
        settings, schedule = self._settings, self._settings.schedule
        steps = max(settings.train_pairs // settings.batch, 1)
        # Each epoch has its own stream, so that a resumed run sees the pairs that an unbroken one sees.
        rng = np.random.default_rng((settings.seed, 1, self._epochs))
        batches = self._makers[0].batches(settings.train_pairs, settings.batch, rng)
        self._network.train()
        losses, hits, rate = [], [], schedule.start
        for step, batch in enumerate(prefetched(batches)):
            done = schedule.done(self._epochs + step / steps, time.monotonic() - began)
            if done >= 1.0:
                break
            progress("train", done)
            rate = schedule.rate(done)
            loss, right = self._step(batch, rate)
            losses.append(loss)
            hits.append(right)
        if not losses:
            return _Trained(loss=float("nan"), accuracy=float("nan"), rate=rate)
        return _Trained(loss=float(np.mean(losses)), accuracy=float(np.mean(hits)), rate=rate)

    def _step(self, batch: Batch, rate: float) -> tuple[float, float]:
        """The loss before the step, and the share of pairs that the network had right."""
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        output, labels = self._forward(batch), torch.from_numpy(batch.labels).to(self._device)
        loss = total_loss(output.logits, labels, output.transforms)
        value = loss.item()
        if not np.isfinite(value):
            raise FloatingPointError(
                f"epoch {self._epochs + 1}: the loss is {value}; lower the learning rate"
            )
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        return value, float((output.logits.detach().argmax(dim=1) == labels).float().mean())

    @torch.no_grad()
    def _validate(self, began: float, progress: Progress) -> Measured:
        """On the same pairs after every epoch."""
        settings = self._settings
        rng = np.random.default_rng((settings.seed, 2))
        batches = prefetched(self._makers[1].batches(settings.validation_pairs, settings.batch, rng))
        self._network.eval()
        logits, labels = [], []
        for batch in batches:
            progress("train", settings.schedule.done(self._epochs + 1, time.monotonic() - began))
            logits.append(self._forward(batch).logits.cpu())
            labels.append(torch.from_numpy(batch.labels))
        answers, truth = torch.cat(logits), torch.cat(labels)
        loss = float(total_loss(answers, truth, (torch.eye(3)[None],)))
        return measured(answers.softmax(dim=1).numpy(), truth.numpy(), loss)

    @torch.no_grad()
    def _settle(self) -> None:
        """Initialise the head by the data of a few batches."""
        rng = np.random.default_rng((self._settings.seed, 0))
        sides, statistics = [], []
        for batch in self._makers[0].batches(SETTLING_PAIRS, self._settings.batch, rng):
            points, reference_sample, current_sample = self._tensors(batch)
            sides.append(self._network.encoder(points, batch.sizes)[0].chunk(2))
            statistics.append(chamfer_statistics(reference_sample, current_sample))
        reference, current = (torch.cat(side) for side in zip(*sides, strict=True))
        self._network.head.settle(reference, current, torch.cat(statistics))

    def _forward(self, batch: Batch) -> PairOutput:
        points, reference_sample, current_sample = self._tensors(batch)
        output: PairOutput = self._network(points, batch.sizes, reference_sample, current_sample)
        return output

    def _tensors(self, batch: Batch) -> list[Tensor]:
        arrays = (batch.points, batch.reference_sample, batch.current_sample)
        return [torch.from_numpy(array).to(self._device) for array in arrays]

    def _save(self, name: str, more: dict[str, Any]) -> None:
        """Written beside and moved, so that a stop in between leaves the old file whole."""
        state = {
            "settings": asdict(self._settings),
            "network": self._network.state_dict(),
            "epochs": self._epochs,
            "seconds": self._seconds,
            "best": list(self._best),
            "best_epoch": self._best_epoch,
            **more,
        }
        partial = self._out / f"{name}.partial"
        torch.save(state, partial)
        partial.replace(self._out / name)

    def _log(self, trained: _Trained, found: Measured) -> EpochRow:
        row = EpochRow(
            epoch=self._epochs,
            seconds=round(self._seconds, 1),
            learning_rate=trained.rate,
            train_loss=trained.loss,
            train_accuracy=trained.accuracy,
            validation_loss=found.loss,
            accuracy=found.accuracy,
            **_by_class("precision", found.precision),
            **_by_class("recall", found.recall),
        )
        path = self._out / LOG
        fresh = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(asdict(row)))
            if fresh:
                writer.writeheader()
            writer.writerow(asdict(row))
        return row

    def _cut_log(self) -> None:
        """Without what was written of an epoch whose checkpoint was not; in today's columns."""
        path = self._out / LOG
        if not path.exists():
            return
        with path.open(newline="") as file:
            kept = [row for row in csv.DictReader(file) if int(row["epoch"]) <= self._epochs]
        partial = path.with_name(f"{LOG}.partial")
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(EpochRow)], extrasaction="ignore")
            writer.writeheader()
            writer.writerows(kept)
        partial.replace(path)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Trained:
    """What the steps of an epoch say."""

    loss: float  #: mean; NaN where the time was up before the first step
    accuracy: float
    rate: float  #: the last one


def _whole(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings of a checkpoint; what they do not know yet has its default."""
    default = asdict(TrainSettings())
    return {**default, **settings, "pairs": {**default["pairs"], **settings["pairs"]}}


def _by_class(name: str, values: tuple[float, float, float]) -> dict[str, float]:
    classes = ("unchanged", "changed", "different")
    return {f"{name}_{of}": value for of, value in zip(classes, values, strict=True)}
