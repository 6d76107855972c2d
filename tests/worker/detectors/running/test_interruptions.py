"""Steps that an error is raised in from outside, wherever they are: the others, and those who come, go on."""

from __future__ import annotations

import random
import sys
import threading
from collections.abc import Iterator, Sequence
from queue import SimpleQueue

import pytest

from tests.support.detectors import CountingDetector
from worker.detectors.running.calls import FittedRuns, NetworkCall
from worker.detectors.running.shared import SharedBatches
from worker.detectors.running.warm import WarmModels
from worker.rq_jobs import StepTimedOut
from worker.rq_threads import Door

WATCHDOG_S = 60.0  #: what takes longer never ends
STEPS, TIME_LIMITS = 6, 300


def doubled(items: Sequence[int]) -> list[int]:
    return [2 * item for item in items]


CALL = NetworkCall(model="m/1", function="double", fingerprint="", run=doubled)


def quietly(done: int) -> None:
    pass


def ended(thread: threading.Thread) -> None:
    thread.join(WATCHDOG_S)
    assert not thread.is_alive(), "it waits for ever"


def asked(batches: SharedBatches, warm: WarmModels, count: int = 5) -> list[int]:
    """Ask as a step does: a model that is kept open, then a few batches."""
    with warm.borrow("m/1", CountingDetector), batches.expect("m/1"):
        return batches.run(CALL, range(count), quietly)


def serves_as_before(batches: SharedBatches, warm: WarmModels) -> None:
    """Whoever comes next is served, alone: no one is waited for, and no model is in use for ever."""
    results: list[list[int]] = []
    last = threading.Thread(target=lambda: results.append(asked(batches, warm)), daemon=True)
    last.start()
    ended(last)
    assert results == [[0, 2, 4, 6, 8]]
    warm._close_idle(0)
    assert warm.held.models == 0


@pytest.fixture
def hasty() -> Iterator[None]:
    """Threads take turns after a few instructions, so that errors land anywhere."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("hasty")
def test_time_limits_of_many_steps_leave_nothing_locked() -> None:
    batches, warm = SharedBatches(FittedRuns(4), wait_s=0.001), WarmModels(1 << 30)
    # Not a semaphore: an error that lands in its release would leave the test itself locked.
    served, rng = SimpleQueue[None](), random.Random(0)

    def step(door: Door, began: SimpleQueue[None]) -> None:
        try:
            with door:
                began.put(None)
                while True:
                    assert asked(batches, warm) == [0, 2, 4, 6, 8]
                    served.put(None)
        except StepTimedOut:
            pass
        finally:
            door.shut()

    def started() -> tuple[threading.Thread, Door]:
        door, began = Door(), SimpleQueue[None]()
        thread = threading.Thread(target=step, args=(door, began), daemon=True)
        thread.start()
        began.get(timeout=WATCHDOG_S)
        return thread, door

    steps = [started() for _ in range(STEPS)]
    for _ in range(TIME_LIMITS):
        served.get(timeout=WATCHDOG_S)  # raises Empty where nobody is served any more
        thread, door = steps.pop(rng.randrange(STEPS))
        door.leave(StepTimedOut)
        ended(thread)
        steps.append(started())
    for thread, door in steps:
        door.leave(StepTimedOut)
        ended(thread)
    serves_as_before(batches, warm)
