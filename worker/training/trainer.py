"""Trains a network on pairs of tiles (paper, Section 3.8) and can be stopped and taken up again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from worker.detectors.trainable import Labelled
from worker.files import write_atomically
from worker.metrics import ClassFigures, class_figures
from worker.progress import Progress, no_progress
from worker.training.dataset import TileSet, load_tiles, split_tiles
from worker.training.head import train_head
from worker.training.log import append_row, cut_log
from worker.training.pairs import PairMaker
from worker.training.prefetch import prefetched
from worker.training.settings import TrainSettings, whole
from worker.training.steps import Steps

INITIALIZATION_PAIRS = 128  #: that the head is initialised by
CHECKPOINT, BEST = "last.pt", "best.pt"


def train(
    settings: TrainSettings,
    dataset: Path,
    out: Path,
    progress: Progress = no_progress,
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
    if settings.head_epochs:
        run.finish_head(training, validation, progress)
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
        self._kind = settings.network
        self._network = self._kind.build(coarse_search=settings.coarse_search).to(self._device)
        self._steps = Steps(self._network, rate=settings.learning_rate, weight_decay=settings.weight_decay)
        self._makers = PairMaker(training, settings.pairs), PairMaker(validation, settings.pairs)
        if start is None and settings.start_from is not None:
            start = torch.load(settings.start_from, map_location=self._device, weights_only=True)["network"]
        if start is not None:
            self._kind.start_from(self._network, start, fresh_head=settings.fresh_head)
        fresh = settings.initialize_head and (start is None or settings.fresh_head)
        if fresh and settings.epochs:  # without an epoch it is the training of the head alone that begins it
            rng = np.random.default_rng((settings.seed, 0))
            batches = self._batches(self._makers[0], INITIALIZATION_PAIRS, rng)
            self._kind.initialize_from_data(self._network, batches)
        self._epochs = 0
        self._seconds = 0.0
        self._best = (-1.0, -1.0)
        self._best_epoch = 0

    @property
    def finished(self) -> bool:
        """The epochs or the time are spent, or nothing has become better for long."""
        stale = self._epochs - self._best_epoch >= self._settings.patience
        return stale or self._settings.schedule.done(self._epochs, self._seconds) >= 1.0

    def epoch(self, progress: Progress) -> None:
        """Train on one epoch's pairs, validate, and keep both checkpoints and the log."""
        began = time.monotonic() - self._seconds
        self._train_pass(began, progress)
        figures = self._validate(began, progress)
        self._epochs += 1
        self._seconds = time.monotonic() - began
        if figures.rank > self._best:
            self._best, self._best_epoch = figures.rank, self._epochs
            self._save(BEST, {"measured": asdict(figures)})
        append_row(self._out, self._steps.row(figures, epoch=self._epochs, seconds=self._seconds))
        optimizer = self._steps.optimizer.state_dict()
        self._save(CHECKPOINT, {"optimizer": optimizer, "torch_rng": torch.get_rng_state()})

    def finish_head(self, training: TileSet, validation: TileSet, progress: Progress) -> None:
        """Train the best network's head alone, unless that was done before."""
        path = self._out / BEST
        if not path.exists():  # no epoch was asked for
            self._save(BEST, {"measured": None})
        state = torch.load(path, map_location=self._device, weights_only=True)
        if "head" in state:
            return
        network = self._kind.build().to(self._device)
        network.load_state_dict(state["network"])
        result = train_head(network, training, validation, self._settings, self._out, progress)
        more = {
            "network": network.state_dict(),
            "measured": asdict(result.measured),
            "head": asdict(result),
            "settings": asdict(self._settings),
        }
        write_atomically(path, partial(torch.save, {**state, **more}))

    def resume(self) -> None:
        """Take up the last checkpoint, if the folder has one."""
        path = self._out / CHECKPOINT
        if path.exists():
            self._take_up(path)
        cut_log(self._out, self._epochs)

    def _take_up(self, path: Path) -> None:
        state = torch.load(path, map_location=self._device, weights_only=True)
        if _of_epochs(whole(state["settings"])) != _of_epochs(asdict(self._settings)):
            raise ValueError(f"{path} was made with other settings; use them, or another folder")
        self._network.load_state_dict(state["network"])
        self._steps.optimizer.load_state_dict(state["optimizer"])
        torch.set_rng_state(state["torch_rng"].cpu())
        self._epochs, self._seconds = state["epochs"], state["seconds"]
        self._best, self._best_epoch = tuple(state["best"]), state["best_epoch"]

    def _train_pass(self, began: float, progress: Progress) -> None:
        """Take one epoch's steps; end early when the time is up. Raises FloatingPointError for a loss of NaN."""
        settings, schedule = self._settings, self._settings.schedule
        steps = max(settings.train_pairs // settings.batch, 1)
        # Each epoch has its own stream, so that a resumed run sees the pairs that an unbroken one sees.
        rng = np.random.default_rng((settings.seed, 1, self._epochs))
        batches = self._batches(self._makers[0], settings.train_pairs, rng)
        self._network.train()
        for step, batch in enumerate(prefetched(batches)):
            done = schedule.done(self._epochs + step / steps, time.monotonic() - began)
            if done >= 1.0:
                break
            progress("train", done)
            logits, loss = self._kind.answer(self._network, batch)
            labels = torch.from_numpy(batch.labels)
            value = self._steps.take(logits, labels, loss, rate=schedule.rate(done))
            if not np.isfinite(value):
                raise FloatingPointError(
                    f"epoch {self._epochs + 1}: the loss is {value}; lower the learning rate"
                )

    @torch.no_grad()
    def _validate(self, began: float, progress: Progress) -> ClassFigures:
        """Validate on the same pairs after every epoch."""
        settings = self._settings
        rng = np.random.default_rng((settings.seed, 2))
        batches = prefetched(self._batches(self._makers[1], settings.validation_pairs, rng))
        self._network.eval()
        logits, labels = [], []
        for batch in batches:
            progress("train", settings.schedule.done(self._epochs + 1, time.monotonic() - began))
            logits.append(self._kind.answer(self._network, batch)[0].cpu())
            labels.append(torch.from_numpy(batch.labels))
        answers, truth = torch.cat(logits), torch.cat(labels)
        loss = float(self._kind.class_loss(answers, truth))
        return class_figures(answers.softmax(dim=1).numpy(), truth.numpy(), loss)

    def _batches(self, maker: PairMaker, count: int, rng: np.random.Generator) -> Iterator[Labelled]:
        """Draw `count` pairs; both they and what their collation draws come from `rng`."""
        for pairs in maker.batches(count, self._settings.batch, rng):
            yield self._kind.collate(pairs, rng)

    def _save(self, name: str, more: dict[str, Any]) -> None:
        state = {
            "settings": asdict(self._settings),
            "network": self._network.state_dict(),
            "epochs": self._epochs,
            "seconds": self._seconds,
            "best": list(self._best),
            "best_epoch": self._best_epoch,
            **more,
        }
        write_atomically(self._out / name, partial(torch.save, state))


def _of_epochs(settings: dict[str, Any]) -> dict[str, Any]:
    """Leave out what only comes after the last epoch, and may be asked for then."""
    return {name: value for name, value in settings.items() if not name.startswith("head_")}
