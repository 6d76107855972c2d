"""Models that a process keeps open, so that a step need not read and place their weights again."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from worker.detectors.detector import Detector
from worker.detectors.running.calls import give_cache_back
from worker.detectors.running.meter import Meter
from worker.detectors.store import Weights

log = logging.getLogger("worker.detectors")

LEAST_BYTES = 1 << 20  #: that a model counts, also one without weights


@dataclass(frozen=True, kw_only=True, slots=True)
class Held:
    """What is open."""

    models: int = 0
    bytes: int = 0  #: of their weights


@dataclass(slots=True)
class _Warm:
    detector: Detector
    size: int
    users: int = 0


class WarmModels:
    """Opens models and keeps them, up to so many bytes of weights; who was used longest ago is closed first.

    A model in use is not closed, so those in use at a time may be more than the bound. Safe to share between threads.
    """

    def __init__(self, most_bytes: int, meter: Meter | None = None) -> None:
        self._most, self._meter = most_bytes, meter or Meter()
        self._lock = threading.Lock()
        self._models: OrderedDict[Hashable, _Warm] = OrderedDict()  #: who was used last is last
        self._opening: dict[Hashable, threading.Lock] = {}

    @property
    def held(self) -> Held:
        """What is open now."""
        with self._lock:
            return Held(models=len(self._models), bytes=sum(warm.size for warm in self._models.values()))

    @contextmanager
    def borrow(self, key: Hashable, opened: Callable[[], Detector]) -> Iterator[Detector]:
        """Give the model of a key for the length of a block; `opened` opens it, and may raise, where it is not open."""
        warm = self._taken(key, opened)
        try:
            yield warm.detector
        finally:
            with self._lock:
                warm.users -= 1
            self._close_idle()

    def _taken(self, key: Hashable, opened: Callable[[], Detector]) -> _Warm:
        with self._lock:
            opening = self._opening.setdefault(key, threading.Lock())
        with opening:  # two steps that need the same model open it once
            with self._lock:
                warm = self._models.get(key)
                if warm is not None:
                    warm.users += 1
                    self._models.move_to_end(key)
                    return warm
            detector = opened()
            warm = _Warm(detector, weight_of(detector), users=1)
            with self._lock:
                self._models[key] = warm
        self._meter.add("models_opened", detector.card.model)
        self._close_idle()
        return warm

    def _close_idle(self) -> None:
        closed = []
        with self._lock:
            excess = sum(warm.size for warm in self._models.values()) - self._most
            for key, warm in list(self._models.items()):
                if excess > 0 and not warm.users:
                    closed.append(self._models.pop(key).detector.card.model)
                    self._opening.pop(key, None)
                    excess -= warm.size
        for model in closed:
            log.info("model %s is closed: others need the room", model)
            self._meter.add("models_evicted", model)
        if closed:
            give_cache_back()


def weight_of(detector: Detector) -> int:
    """Return the bytes of a detector's weights, `LEAST_BYTES` at least."""
    weights: Callable[[], Weights] = getattr(detector, "weights", dict)
    return max(LEAST_BYTES, sum(tensor.nbytes for tensor in weights().values()))
