"""Dynamic batching: one thread owns the networks of a process, and fills its batches with items of several steps.

The thread of a step hands its items over and waits; whatever is raised in it there, a dismissal, its time limit, the
end of its worker, withdraws what is left of them. The network's thread hears of none of that. Batches are filled from
all steps that wait for the same function of the same model, an item of each in turn, so that a large survey holds up no
small one; the functions take turns too. A batch that is not full waits for more, but a few milliseconds at most, and
only while another step has the model in hand (as in NVIDIA Triton's dynamic batcher, `max_queue_delay`).

A time limit is raised between any two instructions of a step's thread, also within those of `threading.Condition`,
which then stays locked for ever. So the threads share no lock: all that they tell each other goes through queues that
CPython runs as one instruction, and what a step has in hand is known by a weak reference, which ends with its thread.
"""

from __future__ import annotations

import logging
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from worker.detectors.running.calls import Done, FittedRuns, NetworkCall, give_cache_back
from worker.detectors.running.schedule import Batch, Failure, Request, Schedule, User
from worker.errors import DeviceLost, OutOfMemory

log = logging.getLogger("worker.detectors")

I = TypeVar("I")  # noqa: E741 - an item of a batch
R = TypeVar("R")

WAIT_S = 0.005  #: that a batch waits for more items, from the first on
_LISTEN_S = (
    0.1  #: a waiting thread looks up so often: an error that is raised in it from outside is heard only then
)


class _End:
    """A message: nobody is left who could ask for anything."""


_Inbox = SimpleQueue[Any]  #: of requests, users, `_End`; all else says that somebody has gone


class _Token:
    """What a step holds on to while it has a model in hand."""


class SharedBatches:
    """Runs calls of several threads together (`worker.detectors.running.calls.Batches`).

    To be made in a thread that nothing is raised in from outside: it starts that of the networks.
    """

    def __init__(
        self,
        fitted: FittedRuns | None = None,
        *,
        wait_s: float = WAIT_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._inbox: _Inbox = SimpleQueue()
        fitted = fitted or FittedRuns()
        server = _Server(fitted, Schedule(fitted, wait_s, clock), self._inbox, clock)
        self._network = threading.Thread(target=server.serve, name="network", daemon=True)
        self._network.start()
        weakref.finalize(self, self._inbox.put, _End()).atexit = False

    def run(self, call: NetworkCall[I, R], items: Sequence[I], done: Done) -> list[R]:
        """Return the result of each item (`Batches.run`); `done` is called a few times a second at least."""
        done(0)
        if not items:
            return []
        request = Request(call, items, self._clock())
        results: dict[int, R] = {}
        try:
            self._inbox.put(request)
            while len(results) < len(items):
                self._hear(request, results)
                done(len(results))
        finally:
            request.withdrawn = True
            self._inbox.put(None)
        return [results[row] for row in range(len(items))]

    @contextmanager
    def expect(self, model: str) -> Iterator[None]:
        """Say for the length of a block that its thread may ask for calls of a model: batches wait for it a little.

        The end of the token ends that, and sends a message that it has, however the thread leaves.
        """
        token = _Token()
        self._inbox.put(User(model, weakref.ref(token, self._inbox.put)))
        try:
            yield
        finally:
            del token

    def _hear(self, request: Request[I, R], results: dict[int, R]) -> None:
        """Take in what has come of a request, and wait for it a little. Raises what went wrong."""
        try:
            news = request.news.get(timeout=_LISTEN_S)
        except Empty:
            if not self._network.is_alive():
                raise DeviceLost("the thread that runs the networks has ended") from None
            return
        if isinstance(news, Failure):
            raise news.take()
        results.update(news)


class _Server:
    """What the network's thread does. Between two batches it holds on to nothing of those who asked."""

    def __init__(
        self, fitted: FittedRuns, schedule: Schedule, inbox: _Inbox, clock: Callable[[], float]
    ) -> None:
        self._fitted, self._schedule, self._inbox, self._clock = fitted, schedule, inbox, clock

    def serve(self) -> None:
        """Run batches until `_End` comes."""
        while self._listen():
            self._run_batch(self._schedule.take())

    def _listen(self) -> bool:
        """Take messages until a batch is due; False at the end."""
        while True:
            while not self._inbox.empty():
                if not self._heard(self._inbox.get()):
                    return False
            left = self._schedule.left_s()
            if left is not None and left <= 0:
                return True
            with suppress(Empty):
                if not self._heard(self._inbox.get(timeout=left)):
                    return False

    def _heard(self, message: object) -> bool:
        if isinstance(message, Request | User):
            self._schedule.add(message)
        return not isinstance(message, _End)

    def _run_batch(self, batch: Batch) -> None:
        """Run a batch; where it fails, each step's part by itself, so that an error is only its own."""
        error = self._attempt(batch)
        if error is None:
            return
        requests = list(dict.fromkeys(request for request, _ in batch))
        if isinstance(error, DeviceLost):  # of no use to any of them, nor to those who come
            for request in requests:
                request.fail(DeviceLost(str(error)))
        elif len(requests) == 1:
            requests[0].fail(error)
        else:
            for request in requests:
                self._run_batch([entry for entry in batch if entry[0] is request])

    def _attempt(self, batch: Batch) -> BaseException | None:
        """Run a batch, and tell its requests; return the error that it failed with, which holds on to nothing."""
        call, failed = batch[0][0].call, None
        try:
            self._run_together(batch)
        except DeviceLost as error:
            return _released(error)
        except BaseException as error:
            steps = len({id(request) for request, _ in batch})
            log.warning("model %s: a batch of %d steps failed", call.model, steps, exc_info=error)
            failed = _released(error)
        if failed is not None:  # only here, for until then the error is being handled
            give_cache_back()
        return failed

    def _run_together(self, batch: Batch) -> None:
        call = batch[0][0].call
        results = self._fitted.run(call, [request.items[row] for request, row in batch])
        if len(results) != len(batch):
            raise RuntimeError(
                f"{call.function} of {call.model} gave {len(results)} results of {len(batch)} items"
            )
        found: dict[Request[Any, Any], dict[int, Any]] = {request: {} for request, _ in batch}
        for (request, row), result in zip(batch, results, strict=True):
            if isinstance(result, OutOfMemory):
                request.fail(result)
            else:
                found[request][row] = result
        for request, told in found.items():
            request.since = self._clock()  # what is left of it waits from now on
            request.news.put(told)


def _released(error: BaseException) -> BaseException:
    """Drop the frames of an error and of those behind it: they hold what the network had made."""
    chain, seen = [error], set[int]()
    while chain:
        one = chain.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        traceback.clear_frames(one.__traceback__)
        one.__traceback__ = None
        chain += [other for other in (one.__cause__, one.__context__) if other is not None]
    return error
