"""A network as functions of batches, and how a batch comes to fit into the memory of the device."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import torch

from worker.detectors.running.meter import Meter
from worker.errors import DeviceLost, OutOfMemory

log = logging.getLogger("worker.detectors")

I = TypeVar("I")  # noqa: E741 - an item of a batch
R = TypeVar("R")

Done = Callable[[int], None]  #: told how many items have their results; may raise, which withdraws the others

MOST = 64  #: the size of a batch where nobody says otherwise: about 1 GiB beside the network for patches of 4,096 points

GPU_SHARED = 0.9  #: of the GPU's memory, that workers divide among themselves where nothing is set

#: What CUDA's libraries say where they find no room for what they keep beside torch's arrays.
_FULL = re.compile(
    "CUDA (driver )?error: "
    "(out of memory|CUBLAS_STATUS_ALLOC_FAILED|CUBLAS_STATUS_NOT_INITIALIZED when calling .?cublasCreate"
    "|insufficient resources|resource allocation failed)"
)


class NetworkFailed(Exception):
    """CUDA refused something that a network asked for, and computes on: the same would fail again."""


def _one(_: object) -> int:
    return 1


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class NetworkCall(Generic[I, R]):
    """One function of a model's network, for any number of items at once; what it says of one is its own affair.

    The result of an item does not depend on the items beside it, up to the rounding of `run`.
    """

    model: str  #: `name/version`
    function: str  #: of the network, as `encode`
    fingerprint: str  #: of the weights
    run: Callable[[Sequence[I]], Sequence[R]]  #: one result an item, in their order
    size: Callable[[I], int] = field(
        default=_one
    )  #: of an item in a batch; 1 is a patch, some 16 MiB of activations
    most: int | None = None  #: size of a batch that more would not make faster; None: as large as may be

    @property
    def key(self) -> tuple[str, str, str]:
        """What the memory that it needs is remembered under, also when the model is opened again."""
        return self.model, self.fingerprint, self.function


class Batches(Protocol):
    """Runs calls; `worker.detectors.running.shared.SharedBatches` does it for several threads together."""

    def run(self, call: NetworkCall[I, R], items: Sequence[I], done: Done) -> list[R]:
        """Return the result of each item.

        Raises what `done` raises, OutOfMemory, DeviceLost, and what else the network raises.
        """

    def expect(self, model: str) -> AbstractContextManager[None]:
        """Say for the length of a block that its thread may ask for calls of a model."""


class FittedRuns:
    """Runs batches in as many parts as fit into the memory of the device, and remembers how large these may be.

    One for all threads of a process: a GPU tells that its memory is used up by an error, which says nothing about who
    has it.
    """

    def __init__(self, most: int = MOST, meter: Meter | None = None) -> None:
        self._asked, self.meter = most, meter or Meter()
        self._fits: dict[tuple[str, str, str], int] = {}
        self._lock = threading.Lock()

    def most(self, call: NetworkCall[I, R]) -> int:
        """Return the size that a batch may have."""
        with self._lock:
            fits = self._fits.get(call.key, self._asked)
        return min(fits, self._asked if call.most is None else call.most)

    def parts(self, call: NetworkCall[I, R], items: Sequence[I]) -> Iterator[Sequence[I]]:
        """Cut items into batches, each as large as may be when it is asked for."""
        begin = 0
        while begin < len(items):
            end, size = begin + 1, call.size(items[begin])
            while end < len(items) and size + call.size(items[end]) <= self.most(call):
                size += call.size(items[end])
                end += 1
            yield items[begin:end]
            begin = end

    def run(self, call: NetworkCall[I, R], items: Sequence[I]) -> list[R | OutOfMemory]:
        """Return of each item its result, or the error where it did not fit alone.

        Raises what the network raises; in place of an error of CUDA DeviceLost, or NetworkFailed where it computes on.
        """
        begun = time.perf_counter()
        results: list[R | OutOfMemory] = []
        parts = [items]
        while parts:
            part = parts.pop(0)
            found = self._fitting(call, part)
            if found is not None:
                results += found
            elif len(part) == 1:
                results.append(_too_large(call))
            else:
                middle = (len(part) + 1) // 2
                self._remember(call, sum(map(call.size, part)) // 2)
                parts[:0] = [part[:middle], part[middle:]]
        self.meter.add("network_seconds", call.model, time.perf_counter() - begun)
        self.meter.add("batch_size", call.model, len(items))
        return results

    def _fitting(self, call: NetworkCall[I, R], items: Sequence[I]) -> list[R] | None:
        """Return the results; None where the memory of the device did not suffice."""
        lost = ""
        try:
            return list(call.run(items))
        except RuntimeError as error:
            if not is_full_memory(error):
                if not DeviceLost.is_told_by(error):
                    raise
                log.exception("model %s: the device fails", call.model)
                lost = str(error).partition("\n")[0]
        # only here, for the error holds on to what the network had made
        if lost:
            if device_answers():
                raise NetworkFailed(f"model {call.model} fails: {lost}")
            raise DeviceLost(f"the device of model {call.model} fails: {lost}")
        self.meter.add("out_of_memory", call.model)
        log.warning("model %s: %d items at once do not fit into the GPU's memory", call.model, len(items))
        give_cache_back()
        return None

    def _remember(self, call: NetworkCall[I, R], size: int) -> None:
        with self._lock:
            self._fits[call.key] = max(1, min(size, self._fits.get(call.key, size)))


def device_answers() -> bool:
    """Tell whether the GPU still computes for this process: after a fault that sticks each call fails."""
    if not torch.cuda.is_available():
        return False
    try:
        torch.cuda.synchronize()
        return bool(torch.ones(1, device="cuda").add_(1).item() == 2)
    except RuntimeError as error:
        return is_full_memory(error)


def is_full_memory(error: BaseException) -> bool:
    """Tell whether an error says that the memory of a GPU does not suffice, that of torch's arrays or of CUDA itself."""
    return isinstance(error, torch.OutOfMemoryError) or bool(_FULL.search(str(error)))


def give_cache_back() -> None:
    """Give the GPU back what torch keeps for arrays to come."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def limit_gpu_memory(share: float | None, workers: int) -> float:
    """Limit what this process may take of the GPU's memory; return the share, 1 for all.

    With None and several `workers` on the GPU each has an equal part, and a tenth stays for what CUDA keeps of each
    beside (a few hundred MiB). Beyond its share a process gets torch.OutOfMemoryError, and the others never hear of it.
    """
    part = share or (1.0 if workers < 2 else GPU_SHARED / workers)
    if part < 1:
        torch.cuda.set_per_process_memory_fraction(part)
    return part


def _too_large(call: NetworkCall[I, R]) -> OutOfMemory:
    return OutOfMemory(
        f"model {call.model} needs more of the GPU's memory for one item than is free; "
        "raise SPICD_INFERENCE_GPU_SHARE, or end what else runs there"
    )


class DirectBatches:
    """Runs calls in the thread that asks, one batch after the other."""

    def __init__(self, fitted: FittedRuns | None = None) -> None:
        self._fitted = fitted or FittedRuns()

    def run(self, call: NetworkCall[I, R], items: Sequence[I], done: Done) -> list[R]:
        """Return the result of each item (`Batches.run`); `done` is called before each batch and after the last."""
        results: list[R] = []
        for part in self._fitted.parts(call, items):
            done(len(results))
            self._fitted.meter.add("wait_seconds", call.model, 0.0)
            self._fitted.meter.add("batch_requests", call.model)
            for result in self._fitted.run(call, part):
                if isinstance(result, OutOfMemory):
                    raise result
                results.append(result)
        done(len(results))
        return results

    def expect(self, model: str) -> AbstractContextManager[None]:  # noqa: ARG002  (as Batches has it)
        """Expect nobody: there is nothing to wait for."""
        return nullcontext()
