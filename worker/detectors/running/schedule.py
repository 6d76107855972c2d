"""Which items go into the next batch, and when; the network's thread alone asks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Generic, TypeVar
from weakref import ref

from worker.detectors.running.calls import FittedRuns, NetworkCall

I = TypeVar("I")  # noqa: E741 - an item of a batch
R = TypeVar("R")


class Failure:
    """An error on its way to the step that it is of, which takes it once."""

    def __init__(self, error: BaseException) -> None:
        self._errors = [error]

    def take(self) -> BaseException:
        """Return the error and keep it no more: it will hold the frame that raises it, which holds this."""
        return self._errors.pop()


class Request(Generic[I, R]):
    """The items of one step for one call. What becomes of them is told in `news`."""

    def __init__(self, call: NetworkCall[I, R], items: Sequence[I], since: float) -> None:
        self.call, self.items = call, items
        self.sizes = [call.size(item) for item in items]
        self.news: SimpleQueue[dict[int, R] | Failure] = SimpleQueue()  #: results by row of `items`
        self.since = since  #: when it began to wait for its next batch
        self.next = 0  #: the first item that is in no batch yet
        self.withdrawn = False  #: nobody wants the others any more

    @property
    def waiting(self) -> bool:
        """Whether there are items that have to go into a batch."""
        return not self.withdrawn and self.next < len(self.items)

    def fail(self, error: BaseException) -> None:
        """Tell of an error, and run none of the others."""
        self.withdrawn = True
        self.news.put(Failure(error))


Batch = list[tuple[Request[Any, Any], int]]  #: requests, and which of their items


@dataclass(frozen=True, slots=True)
class User:
    """A step that may ask for calls of a model, for as long as it holds on to the token."""

    model: str
    token: ref[object]


class Schedule:
    """Fills batches from all steps that wait for the same call: an item of each in turn, and the calls in turn too.

    For one thread; a request is withdrawn from another.
    """

    def __init__(self, fitted: FittedRuns, wait_s: float, clock: Callable[[], float]) -> None:
        self._fitted, self._wait_s, self._clock = fitted, wait_s, clock
        self._requests: deque[Request[Any, Any]] = deque()  #: that have items in no batch; the next one first
        self._turns: dict[tuple[str, str, str], int] = {}  #: when each call was served last
        self._users: list[User] = []
        self._served = 0

    def add(self, what: Request[Any, Any] | User) -> None:
        """Take a request to serve, or a step to wait for."""
        if isinstance(what, User):
            self._users.append(what)
        else:
            self._requests.append(what)

    def left_s(self) -> float | None:
        """Return how long the next batch has still to wait for more items, in seconds; None where nothing waits."""
        self._drop_over()
        if not self._requests:
            return None
        call = self._next_call()
        mine = self._of(call)
        if sum(user.model == call.model for user in self._users) <= len(mine):
            return 0.0
        if sum(sum(request.sizes[request.next :]) for request in mine) >= self._fitted.most(call):
            return 0.0
        return min(request.since for request in mine) + self._wait_s - self._clock()

    def take(self) -> Batch:
        """Take the next batch, which `left_s` says is due; who came first this time is last the next."""
        call = self._next_call()
        batch: Batch = []
        first = self._of(call)[0]
        turn, room = deque(self._of(call)), self._fitted.most(call)
        waited = self._clock() - min(request.since for request in turn)
        while turn:
            request = turn.popleft()
            room -= request.sizes[request.next]
            if batch and room < 0:
                break
            batch.append((request, request.next))
            request.next += 1
            if request.waiting:
                turn.append(request)
        self._requests.remove(first)  # those of other calls keep their places
        self._requests.append(first)
        self._drop_over()
        self._served += 1
        self._turns[call.key] = self._served
        self._fitted.meter.add("wait_seconds", call.model, waited)
        self._fitted.meter.add("batch_requests", call.model, len({id(request) for request, _ in batch}))
        return batch

    def _next_call(self) -> NetworkCall[Any, Any]:
        return min(
            (request.call for request in self._requests), key=lambda call: self._turns.get(call.key, 0)
        )

    def _of(self, call: NetworkCall[Any, Any]) -> list[Request[Any, Any]]:
        return [request for request in self._requests if request.call.key == call.key]

    def _drop_over(self) -> None:
        self._requests = deque(request for request in self._requests if request.waiting)
        self._users = [user for user in self._users if user.token() is not None]
