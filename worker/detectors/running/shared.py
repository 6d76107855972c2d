"""Dynamic batching: one thread owns the networks of a process, and fills its batches with items of several steps.

The thread of a step hands its items over and waits; whatever is raised in it there, a dismissal, its time limit, the
end of its worker, withdraws what is left of them. The network's thread hears of none of that. Batches are filled from
all steps that wait for the same function of the same model, an item of each in turn, so that a large survey holds up no
small one; the functions take turns too. A batch that is not full waits for more, but a few milliseconds at most, and
only while another step has the model in hand (as in NVIDIA Triton's dynamic batcher, `max_queue_delay`).
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from worker.detectors.running.calls import Done, FittedRuns, NetworkCall
from worker.errors import OutOfMemory

log = logging.getLogger("worker.detectors")

I = TypeVar("I")  # noqa: E741 - an item of a batch
R = TypeVar("R")

WAIT_S = 0.005  #: that a batch waits for more items, from the first on
_LISTEN_S = (
    0.1  #: a waiting thread looks up so often: an error that is raised in it from outside is heard only then
)


class _Request(Generic[I, R]):
    """The items of one step for one call."""

    def __init__(self, call: NetworkCall[I, R], items: Sequence[I], since: float) -> None:
        self.call, self.items, self.since = call, items, since
        self.results: dict[int, R] = {}
        self.next = 0  #: the first item that is in no batch yet
        self.error: BaseException | None = None

    @property
    def waiting(self) -> bool:
        return self.error is None and self.next < len(self.items)


_Batch = list[tuple[_Request[Any, Any], int]]  #: requests, and which of their items


class SharedBatches:
    """Runs calls of several threads together (`worker.detectors.running.calls.Batches`)."""

    def __init__(
        self,
        fitted: FittedRuns | None = None,
        *,
        wait_s: float = WAIT_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._fitted, self._wait_s, self._clock = fitted or FittedRuns(), wait_s, clock
        self._changed = threading.Condition()
        self._requests: deque[_Request[Any, Any]] = (
            deque()
        )  #: that have items in no batch; the next one first
        self._turns: dict[tuple[str, str, str], int] = {}  #: when each call was served last
        self._users: Counter[str] = Counter()  #: steps that have a model in hand
        self._served = 0
        self._thread: threading.Thread | None = None

    def run(self, call: NetworkCall[I, R], items: Sequence[I], done: Done) -> list[R]:
        """Return the result of each item (`Batches.run`); `done` is called a few times a second at least."""
        request = _Request(call, items, self._clock())
        done(0)
        if not items:
            return []
        with self._changed:
            self._requests.append(request)
            self._changed.notify_all()
        try:
            told = 0
            while len(request.results) < len(items):
                with self._changed:
                    self._start()
                    if not _has_news(request, told):
                        self._changed.wait(_LISTEN_S)
                    told = len(request.results)
                if request.error is not None:
                    raise request.error
                done(told)
        finally:
            with self._changed:
                request.next = len(items)
                self._drop_served()
                self._changed.notify_all()
        return [request.results[row] for row in range(len(items))]

    @contextmanager
    def expect(self, model: str) -> Iterator[None]:
        """Say for the length of a block that its thread may ask for calls of a model: batches wait for it a little."""
        self._count_user(model, 1)
        try:
            yield
        finally:
            self._count_user(model, -1)

    def _count_user(self, model: str, change: int) -> None:
        with self._changed:
            self._users[model] += change
            self._changed.notify_all()

    def _start(self) -> None:
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._serve, name="network", daemon=True)
            self._thread.start()

    def _serve(self) -> None:
        while True:
            with self._changed:
                batch = self._next_batch()
            self._run_batch(batch)

    def _next_batch(self) -> _Batch:
        """Wait for items; return those of the call whose turn it is, once they are enough or have waited enough."""
        while True:
            if not self._requests:
                self._changed.wait()
                continue
            call = min((request.call for request in self._requests), key=self._turn)
            left = self._left_s(call)
            if left <= 0:
                return self._filled(call)
            self._changed.wait(left)

    def _turn(self, call: NetworkCall[Any, Any]) -> int:
        return self._turns.get(call.key, 0)

    def _left_s(self, call: NetworkCall[Any, Any]) -> float:
        """Return how long a batch of a call has still to wait for more, in seconds."""
        mine = self._of(call)
        if self._users[call.model] <= len(mine):
            return 0.0
        room = self._fitted.most(call)
        for request in mine:
            for item in request.items[request.next :]:
                room -= call.size(item)
                if room <= 0:
                    return 0.0
        return min(request.since for request in mine) + self._wait_s - self._clock()

    def _of(self, call: NetworkCall[Any, Any]) -> list[_Request[Any, Any]]:
        return [request for request in self._requests if request.call.key == call.key]

    def _filled(self, call: NetworkCall[Any, Any]) -> _Batch:
        """Take an item of each request in turn until the batch is full; who came first this time is last the next."""
        batch: _Batch = []
        turn, room = deque(self._of(call)), self._fitted.most(call)
        waited = self._clock() - min(request.since for request in turn)
        while turn:
            request = turn.popleft()
            room -= call.size(request.items[request.next])
            if batch and room < 0:
                break
            batch.append((request, request.next))
            request.next += 1
            if request.waiting:
                turn.append(request)
        self._requests.rotate(-1)
        self._drop_served()
        self._served += 1
        self._turns[call.key] = self._served
        self._fitted.meter.add("wait_seconds", call.model, waited)
        self._fitted.meter.add("batch_requests", call.model, len({id(request) for request, _ in batch}))
        return batch

    def _drop_served(self) -> None:
        self._requests = deque(request for request in self._requests if request.waiting)

    def _run_batch(self, batch: _Batch) -> None:
        """Run a batch; where it fails, each step's part by itself, so that an error is only its own."""
        try:
            self._run_together(batch)
        except Exception as error:
            requests = list(dict.fromkeys(request for request, _ in batch))
            if len(requests) == 1:
                self._fail(requests[0], error)
                return
            log.warning(
                "model %s: a batch of %d steps failed (%s)", requests[0].call.model, len(requests), error
            )
            for request in requests:
                self._run_batch([entry for entry in batch if entry[0] is request])

    def _run_together(self, batch: _Batch) -> None:
        call = batch[0][0].call
        results = self._fitted.run(call, [request.items[row] for request, row in batch])
        if len(results) != len(batch):
            raise RuntimeError(
                f"{call.function} of {call.model} gave {len(results)} results of {len(batch)} items"
            )
        with self._changed:
            for (request, row), result in zip(batch, results, strict=True):
                if isinstance(result, OutOfMemory):
                    request.error = result
                else:
                    request.results[row] = result
                request.since = self._clock()  # what is left of it waits from now on
            self._drop_served()
            self._changed.notify_all()

    def _fail(self, request: _Request[Any, Any], error: BaseException) -> None:
        with self._changed:
            request.error = error
            self._drop_served()
            self._changed.notify_all()


def _has_news(request: _Request[Any, Any], told: int) -> bool:
    return request.error is not None or len(request.results) > told
