"""Steps of Adam, on a whole network or on its head alone, and what the steps of one epoch say."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from worker.metrics import ClassFigures
from worker.training.log import EpochRow


class Steps:
    """The optimiser of one training, and the losses and hits since the last row of its log."""

    def __init__(self, module: nn.Module, *, rate: float, weight_decay: float) -> None:
        self.optimizer = torch.optim.Adam(module.parameters(), lr=rate, weight_decay=weight_decay, fused=True)
        self._start = self._rate = rate
        self._losses: list[float] = []
        self._hits: list[float] = []

    def take(self, logits: Tensor, labels: Tensor, loss: Tensor, *, rate: float) -> float:
        """Take a step against the loss of logits (n, 3) at this learning rate; return what the loss was before it."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self._rate = rate
        self._losses.append(loss.item())
        self._hits.append(float((logits.detach().argmax(dim=1).cpu() == labels.cpu()).float().mean()))
        return self._losses[-1]

    def row(self, figures: ClassFigures, *, epoch: int, seconds: float) -> EpochRow:
        """Return the row of the epoch that ends here; its loss and accuracy are NaN where no step was taken."""
        row = EpochRow.of(
            figures,
            epoch=epoch,
            seconds=round(seconds, 1),
            learning_rate=self._rate,
            train_loss=float(np.mean(self._losses)) if self._losses else float("nan"),
            train_accuracy=float(np.mean(self._hits)) if self._hits else float("nan"),
        )
        self._losses, self._hits, self._rate = [], [], self._start
        return row
