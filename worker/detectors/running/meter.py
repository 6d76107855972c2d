"""What the running of networks counts, until somebody takes it."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Literal

Figure = Literal[
    "wait_seconds",  #: of the item of a batch that waited longest
    "batch_size",  #: items of a batch
    "batch_requests",  #: steps that a batch has items of
    "network_seconds",  #: of a batch, to the results in the process's own memory
    "out_of_memory",  #: batches that did not fit and were halved
    "models_opened",
    "models_evicted",
]
Counted = Mapping[tuple[Figure, str], tuple[int, float]]  #: by figure and model: how often, and the sum


class Meter:
    """Counts and sums by figure and model; safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counted: dict[tuple[Figure, str], tuple[int, float]] = {}

    def add(self, figure: Figure, model: str, value: float = 1.0, *, count: int = 1) -> None:
        """Count a value."""
        with self._lock:
            before, total = self._counted.get((figure, model), (0, 0.0))
            self._counted[figure, model] = before + count, total + value

    def take(self) -> Counted:
        """Return what was counted since the last time."""
        with self._lock:
            counted, self._counted = self._counted, {}
        return counted

    def give_back(self, counted: Counted) -> None:
        """Count again what was taken and could not be kept."""
        for (figure, model), (count, total) in counted.items():
            self.add(figure, model, total, count=count)
