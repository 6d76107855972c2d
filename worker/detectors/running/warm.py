"""Models that a process keeps open, so that a step need not read and place their weights again."""

from __future__ import annotations

import gc
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from weakref import ref

from torch import Tensor

from worker.detectors.detector import Detector
from worker.detectors.running.calls import give_cache_back
from worker.detectors.running.meter import Meter
from worker.detectors.store import Weights
from worker.errors import OutOfMemory

log = logging.getLogger("worker.detectors")

LEAST_BYTES = 1 << 20  #: that a model counts, also one without weights


@dataclass(frozen=True, kw_only=True, slots=True)
class Held:
    """What is open."""

    models: int = 0
    bytes: int = 0  #: of their weights, as the device holds them


class Lease:
    """What a step holds on to while it has a model in hand."""


@dataclass(slots=True, eq=False)
class _Warm:
    detector: Detector
    size: int
    #: Leases that live. An error that is raised in a step from outside may skip what counts it out; its lease ends with
    #: its thread all the same.
    users: set[ref[Lease]] = field(default_factory=set)

    def lend(self, lease: Lease) -> None:
        """Count a step in, until its lease ends."""
        self.users.add(ref(lease, self.users.discard))


class WarmModels:
    """Opens models and keeps them, up to so many bytes of weights; who was used longest ago is closed first.

    A model in use is not closed, so those in use at a time may be more than the bound. Safe to share between threads,
    also such that errors are raised in from outside: its locks are plain ones, that CPython takes and gives back within
    one instruction of `with`.
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
        """Give the model of a key for the length of a block; `opened` opens it, and may raise, where it is not open.

        Raises OutOfMemory where it does not fit into the memory of the device, not even with all others closed that
        nobody uses.
        """
        lease = Lease()
        try:
            yield self._lent(key, opened, lease)
        finally:
            del lease
            self._close_idle(self._most)

    def _lent(self, key: Hashable, opened: Callable[[], Detector], lease: Lease) -> Detector:
        with self._lock:
            opening = self._opening.setdefault(key, threading.Lock())
        with opening:  # two steps that need the same model open it once
            with self._lock:
                warm = self._models.get(key)
                if warm is not None:
                    warm.lend(lease)
                    self._models.move_to_end(key)
                    return warm.detector
            detector = self._opened(opened)
            warm = _Warm(detector, weight_of(detector))
            warm.lend(lease)
            with self._lock:
                self._models[key] = warm
        self._meter.add("models_opened", detector.card.model)
        self._close_idle(self._most)
        return detector

    def _opened(self, opened: Callable[[], Detector]) -> Detector:
        """Open a model; where the memory of the device does not suffice, once more with the others closed."""
        with suppress(OutOfMemory):
            return opened()
        log.warning(
            "a model does not fit into the GPU's memory beside the others: those that nobody uses are closed"
        )
        self._close_idle(0)
        gc.collect()
        give_cache_back()
        return opened()

    def _close_idle(self, most: int) -> None:
        """Close who was used longest ago, and is not in use, until the others take at most so many bytes."""
        closed = self._taken_out(most)
        for model in closed:
            log.info("model %s is closed: others need the room", model)
            self._meter.add("models_evicted", model)
        if closed:
            give_cache_back()

    def _taken_out(self, most: int) -> list[str]:
        """Forget those models, so that their weights go, and return their names."""
        closed = []
        with self._lock:
            excess = sum(warm.size for warm in self._models.values()) - most
            for key in [key for key, warm in self._models.items() if not warm.users]:
                if excess > 0:
                    warm = self._models.pop(key)
                    self._opening.pop(key, None)
                    closed.append(warm.detector.card.model)
                    excess -= warm.size
        return closed


def weight_of(detector: Detector) -> int:
    """Return the bytes that a detector keeps on its device, `LEAST_BYTES` at least.

    That is more than its weights where it keeps them a second time, as its device multiplies them best.
    """
    tensors: Callable[[], Iterable[Tensor]] | None = getattr(detector, "held_tensors", None)
    weights: Callable[[], Weights] = getattr(detector, "weights", dict)
    found = weights().values() if tensors is None else tensors()
    places = {tensor.untyped_storage().data_ptr(): tensor.untyped_storage().nbytes() for tensor in found}
    return max(LEAST_BYTES, sum(places.values()))
