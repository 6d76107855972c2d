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
Counted = Mapping[tuple[str, str], tuple[int, float]]  #: by figure and model: how often, and the sum


class Meter:
    """Counts and sums by figure and model; safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counted: dict[tuple[str, str], tuple[int, float]] = {}

    def add(self, figure: Figure, model: str, value: float = 1.0) -> None:
        """Count a value."""
        self.give_back({(figure, model): (1, value)})

    def take(self) -> Counted:
        """Return what was counted since the last time."""
        with self._lock:
            counted, self._counted = self._counted, {}
        return counted

    def give_back(self, counted: Counted) -> None:
        """Count again what was taken and could not be kept."""
        with self._lock:
            for key, (count, total) in counted.items():
                before, sum_before = self._counted.get(key, (0, 0.0))
                self._counted[key] = before + count, sum_before + total
