"""Trains the head alone, on a frozen encoder: minutes in place of hours, and no less of the classes' balance."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from worker.detectors.trainable import DIFFERENT, TrainableNetwork
from worker.metrics import ClassFigures, class_figures
from worker.progress import Progress, no_progress
from worker.training.dataset import TileSet
from worker.training.kept_pairs import Drawn, PairPool, keep_pairs
from worker.training.log import HEAD_LOG, EpochRow, append_row
from worker.training.settings import Schedule, TrainSettings
from worker.training.steps import Steps

INITIALIZATION_PAIRS = 1024  #: that a head is initialised by; they cost next to nothing


@dataclass(frozen=True, kw_only=True, slots=True)
class HeadResult:
    """What came of it."""

    measured: ClassFigures
    best_epoch: int  #: 0 where no epoch was better than the head that it began with
    epochs: int
    seconds: float


def train_head(
    network: nn.Module,
    training: TileSet,
    validation: TileSet,
    settings: TrainSettings,
    out: Path,
    progress: Progress = no_progress,
) -> HeadResult:
    """Train the network's head in place for `settings.head_epochs`, leave the best one, and log to the folder `out`.

    Loss, rate, choice of the best and pairs an epoch are those of the whole training (paper, Sections 3.7 and 3.8).
    """
    begun = time.monotonic()
    network.eval()
    kind = settings.network
    pools = [
        keep_pairs(kind, network, tiles, settings.pairs, seed=settings.seed, progress=progress)
        for tiles in (training, validation)
    ]
    if settings.initialize_head and not settings.epochs and (settings.fresh_head or not settings.start_from):
        _begin(kind, network, pools[0], settings)
    held_out = pools[1].draw(settings.head_validation_pairs, np.random.default_rng((settings.seed, 6)))
    head = kind.head(network)
    run = _HeadRun(kind, head, pools[0], held_out, settings)
    (out / HEAD_LOG).unlink(missing_ok=True)
    for epoch in range(1, settings.head_epochs + 1):
        progress("train the head", epoch / settings.head_epochs)
        append_row(out, run.epoch(epoch, time.monotonic() - begun), HEAD_LOG)
    head.load_state_dict(run.best)
    return HeadResult(
        measured=run.measured,
        best_epoch=run.best_epoch,
        epochs=settings.head_epochs,
        seconds=round(time.monotonic() - begun, 1),
    )


def _begin(kind: TrainableNetwork[Any], network: nn.Module, pool: PairPool, settings: TrainSettings) -> None:
    """Initialise a head that nothing has trained yet from pairs of one place, whose distances are the fine ones."""
    drawn = pool.draw(INITIALIZATION_PAIRS, np.random.default_rng((settings.seed, 0)))
    same = drawn.labels != DIFFERENT
    kind.begin_head(network, drawn.reference[same], drawn.current[same], drawn.statistics[same])


class _HeadRun:
    """The state of one such training."""

    def __init__(
        self,
        kind: TrainableNetwork[Any],
        head: nn.Module,
        pool: PairPool,
        held_out: Drawn,
        settings: TrainSettings,
    ) -> None:
        torch.manual_seed(settings.seed)
        self._kind, self._head, self._settings = kind, head, settings
        self._pool, self._held_out = pool, held_out
        self._device = next(head.parameters()).device
        self._schedule = Schedule(
            epochs=settings.head_epochs, start=settings.head_learning_rate, end=settings.final_learning_rate
        )
        self._steps = Steps(head, rate=settings.head_learning_rate, weight_decay=settings.weight_decay)
        self.measured = self._validate()
        self.best, self.best_epoch = copy.deepcopy(head.state_dict()), 0

    def epoch(self, number: int, seconds: float) -> EpochRow:
        """Train on newly drawn pairs, and validate on the same held-out ones."""
        settings = self._settings
        rate = self._schedule.rate((number - 1) / settings.head_epochs)
        drawn = self._pool.draw(settings.train_pairs, np.random.default_rng((settings.seed, 7, number)))
        self._head.train()
        for rows in torch.split(torch.arange(len(drawn.labels)), settings.head_batch):
            logits, labels = self._answers(drawn, rows)
            self._steps.take(logits, labels, self._kind.class_loss(logits, labels), rate=rate)
        figures = self._validate()
        if figures.rank > self.measured.rank:
            self.measured, self.best_epoch = figures, number
            self.best = copy.deepcopy(self._head.state_dict())
        return self._steps.row(figures, epoch=number, seconds=seconds)

    @torch.no_grad()
    def _validate(self) -> ClassFigures:
        self._head.eval()
        logits, labels = self._answers(self._held_out, torch.arange(len(self._held_out.labels)))
        loss = float(self._kind.class_loss(logits, labels))
        return class_figures(logits.softmax(dim=1).cpu().numpy(), labels.cpu().numpy(), loss)

    def _answers(self, drawn: Drawn, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        reference, current, statistics, labels = (
            part[rows].to(self._device)
            for part in (drawn.reference, drawn.current, drawn.statistics, drawn.labels)
        )
        return self._head(reference, current, statistics), labels
