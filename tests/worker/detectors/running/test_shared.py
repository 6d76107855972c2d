"""Dynamic batching: batches of several steps, fair, bounded, and none of them hears of another's end."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from worker.detectors.running.calls import FittedRuns, NetworkCall, NetworkFailed, is_full_memory
from worker.detectors.running.meter import Meter
from worker.detectors.running.shared import SharedBatches
from worker.errors import Cancelled, DeviceLost, OutOfMemory

Item = tuple[str, int]  #: survey, number
FOR_EVER = 3600.0


class Held:
    """A network that waits before each batch until the test lets it go on; notes its batches."""

    def __init__(self, model: str = "held/1") -> None:
        self.batches: list[list[Item]] = []
        self.began, self.go = threading.Semaphore(0), threading.Semaphore(0)
        self.fails: Callable[[Sequence[Item]], BaseException | None] = lambda items: None
        self.call = NetworkCall(model=model, function="name", fingerprint="", run=self._run)

    def _run(self, items: Sequence[Item]) -> list[str]:
        self.batches.append(list(items))
        self.began.release()
        assert self.go.acquire(timeout=60)
        error = self.fails(items)
        if error is not None:
            raise error
        return [f"{survey}{number}" for survey, number in items]

    def let(self, batches: int) -> None:
        for _ in range(batches):
            self.go.release()

    def wait_for_batch(self) -> None:
        assert self.began.acquire(timeout=60)


@contextmanager
def asking(batches: SharedBatches) -> Iterator[Callable[..., Future[Any]]]:
    """Asks from a thread each; returns once the items are handed over, so that the network hears of them in this order."""
    with ThreadPoolExecutor(8) as pool:

        def ask(held: Held, survey: str, count: int, done: Callable[[int], None] = lambda done: None) -> Any:
            began, handed = threading.Event(), threading.Event()

            def told(number: int) -> None:
                if began.is_set():  # the second time: it waits
                    handed.set()
                began.set()
                done(number)

            items = [(survey, number) for number in range(count)]
            future = pool.submit(batches.run, held.call, items, told)
            future.add_done_callback(lambda _: handed.set())
            assert handed.wait(60)
            return future

        yield ask


@pytest.fixture
def held() -> Held:
    return Held()


def test_each_survey_gets_its_own_results_in_its_order_of_batches_they_share(held):
    batches = SharedBatches(FittedRuns(6))
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()  # the network is busy: what comes now waits together
        others = [ask(held, "b", 4), ask(held, "c", 2)]
        held.let(2)
        assert first.result(60) == ["a0"]
        assert others[0].result(60) == ["b0", "b1", "b2", "b3"]
        assert others[1].result(60) == ["c0", "c1"]
    assert [len(batch) for batch in held.batches] == [1, 6]


def test_a_batch_has_an_item_of_each_survey_in_turn_so_that_a_large_one_holds_up_no_small_one(held):
    batches = SharedBatches(FittedRuns(4))
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()
        large, small = ask(held, "large", 100), ask(held, "small", 2)
        held.let(2)
        assert small.result(60) == ["small0", "small1"]
        assert not large.done()
        assert held.batches[1] == [("large", 0), ("small", 0), ("large", 1), ("small", 1)]
        held.let(100)
        assert len(large.result(60)) == 100
        first.result(60)
    assert all(len(batch) <= 4 for batch in held.batches)


def test_models_take_turns(held):
    other = Held("other/1")
    batches = SharedBatches(FittedRuns(1))
    with asking(batches) as ask:
        one = ask(held, "a", 3)
        held.wait_for_batch()
        two = ask(other, "b", 2)
        held.let(1)
        other.wait_for_batch()  # though two items of the first model have waited longer
        assert len(held.batches) == 1
        held.let(2)
        other.let(2)
        assert len(one.result(60) + two.result(60)) == 5


def test_a_batch_waits_for_a_step_that_has_the_model_in_hand_and_for_nobody_else(held):
    batches = SharedBatches(FittedRuns(8), wait_s=FOR_EVER)
    with asking(batches) as ask, batches.expect("held/1"):
        alone = ask(held, "a", 2)
        held.let(1)
        assert alone.result(60) == ["a0", "a1"]  # it is the one that was expected
        with batches.expect("held/1"):
            first = ask(held, "b", 2)
            assert len(held.batches) == 1  # it waits
            second = ask(held, "c", 1)
            held.let(1)
            assert first.result(60) + second.result(60) == ["b0", "b1", "c0"]
    assert len(held.batches) == 2


def test_a_batch_that_is_full_waits_for_nobody_and_one_goes_when_the_others_have_gone(held):
    batches = SharedBatches(FittedRuns(3), wait_s=FOR_EVER)
    with asking(batches) as ask, batches.expect("held/1"):
        with batches.expect("held/1"):
            full = ask(held, "a", 3)
            held.let(1)
            assert len(full.result(60)) == 3
            waits = ask(held, "b", 1)
        held.let(1)  # the other step has ended
        assert waits.result(60) == ["b0"]


def test_the_wait_has_a_bound(held):
    batches = SharedBatches(FittedRuns(8), wait_s=0.01)
    held.let(1)
    with asking(batches) as ask, batches.expect("held/1"), batches.expect("held/1"):
        assert ask(held, "a", 2).result(60) == ["a0", "a1"]


def test_a_survey_that_is_dismissed_withdraws_its_items_and_the_other_goes_on(held):
    batches = SharedBatches(FittedRuns(2))
    gone = threading.Event()

    def dismissed(done: int) -> None:
        if gone.is_set():
            raise Cancelled("the job was dismissed")

    with asking(batches) as ask:
        first, other = ask(held, "a", 10, dismissed), None
        held.wait_for_batch()
        other = ask(held, "b", 3)
        gone.set()
        with pytest.raises(Cancelled):
            first.result(60)
        held.let(10)
        assert other.result(60) == ["b0", "b1", "b2"]
    assert [item for batch in held.batches[1:] for item in batch if item[0] == "a"] == []


def test_an_error_is_that_of_the_survey_whose_item_raises_it(held):
    batches = SharedBatches(FittedRuns(8))
    held.fails = lambda items: ValueError("no number") if ("bad", 1) in items else None
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()
        bad, good = ask(held, "bad", 2), ask(held, "good", 2)
        held.let(4)  # the first, the two together, and each by itself
        with pytest.raises(ValueError, match="no number"):
            bad.result(60)
        assert good.result(60) == ["good0", "good1"]
        first.result(60)


def test_out_of_memory_halves_the_batch_and_fails_only_whom_one_item_is_too_much(held):
    meter = Meter()
    batches = SharedBatches(FittedRuns(8, meter))

    def too_much(items: Sequence[Item]) -> BaseException | None:
        if len(items) > 2 or ("huge", 0) in items:
            return torch.OutOfMemoryError("CUDA out of memory")
        return None

    held.fails = too_much
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()
        huge, small = ask(held, "huge", 1), ask(held, "small", 5)
        held.let(50)
        with pytest.raises(OutOfMemory, match="one item"):
            huge.result(60)
        assert len(small.result(60)) == 5
        first.result(60)
        held.batches.clear()
        assert len(ask(held, "later", 5).result(60)) == 5
    assert [len(batch) for batch in held.batches] == [1, 1, 1, 1, 1]
    assert meter.take()["out_of_memory", "held/1"][0] >= 3


def test_what_was_counted_says_how_many_steps_shared_the_batches(held):
    meter = Meter()
    batches = SharedBatches(FittedRuns(8, meter))
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()
        others = [ask(held, "b", 2), ask(held, "c", 3)]
        held.let(2)
        for future in (first, *others):
            future.result(60)
    counted = meter.take()
    assert counted["batch_size", "held/1"] == (2, 6.0)
    assert counted["batch_requests", "held/1"] == (2, 3.0)
    assert counted["wait_seconds", "held/1"][0] == 2


def test_no_items_need_no_network(held):
    assert SharedBatches().run(held.call, [], lambda done: None) == []
    assert held.batches == []


class Thing:
    """What can be seen to go."""


@pytest.fixture
def uncollected() -> Iterator[None]:
    """What goes here goes by itself."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def test_the_idle_thread_holds_on_to_nothing_of_the_last_batch(uncollected):
    def run(items: Sequence[Thing]) -> list[Thing]:
        return [Thing() for _ in items]

    batches, item = SharedBatches(), Thing()
    seen: list[weakref.ref[Any]] = [weakref.ref(item), weakref.ref(run)]
    gone = threading.Event()
    last = weakref.finalize(run, gone.set)
    call = NetworkCall(model="m/1", function="f", fingerprint="", run=run)
    found = batches.run(call, [item], lambda done: None)
    seen.append(weakref.ref(found[0]))
    del call, run, item, found
    assert gone.wait(60), "the model of the last batch is kept"
    assert not last.alive
    assert [one() for one in seen] == [None, None, None]


def test_what_a_batch_that_failed_had_made_is_gone_when_its_parts_are_run_and_from_the_errors(
    uncollected, held
):
    made: list[weakref.ref[Thing]] = []
    kept: list[int] = []

    def fails(items: Sequence[Item]) -> BaseException | None:
        kept.append(sum(one() is not None for one in made))
        if items[0][0] == "a":
            return None
        activations = Thing()
        made.append(weakref.ref(activations))
        try:
            raise ValueError("no number")
        except ValueError as error:
            raise RuntimeError(f"cannot be run: {len(items)}") from error

    held.fails = fails
    batches = SharedBatches(FittedRuns(8))
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()
        others = [ask(held, "b", 2), ask(held, "c", 1)]
        held.let(4)
        errors = [other.exception(60) for other in others]
        first.result(60)
    assert [str(error) for error in errors] == ["cannot be run: 2", "cannot be run: 1"]
    assert kept == [0, 0, 0, 0]
    assert [one() for one in made] == [None, None, None]


def test_a_device_that_fails_is_told_to_all_of_the_batch_and_nothing_is_run_again(held):
    held.fails = lambda items: torch.AcceleratorError(
        "CUDA error: device-side assert triggered\nCUDA kernel errors might be reported later"
    )
    batches = SharedBatches(FittedRuns(8))
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()
        others = [ask(held, "b", 2), ask(held, "c", 2)]
        held.let(9)
        for future in (first, *others):
            with pytest.raises(
                DeviceLost, match=r"model held/1 fails: CUDA error: device-side assert triggered$"
            ):
                future.result(60)
    assert len(held.batches) == 2


def test_what_cuda_refuses_while_it_computes_on_fails_the_step_that_asked_for_it_alone(held, monkeypatch):
    """A launch of odd shape, or no kernel for this GPU: another process would fail at it as well."""
    monkeypatch.setattr("worker.detectors.running.calls.device_answers", lambda: True)
    held.fails = lambda items: (
        torch.AcceleratorError("CUDA error: invalid configuration argument")
        if ("b", 0) in items or ("b", 1) in items
        else None
    )
    batches = SharedBatches(FittedRuns(8))
    with asking(batches) as ask:
        first = ask(held, "a", 1)
        held.wait_for_batch()
        odd, other = ask(held, "b", 2), ask(held, "c", 2)
        held.let(9)
        with pytest.raises(NetworkFailed, match="invalid configuration argument") as told:
            odd.result(60)
        assert not DeviceLost.is_told_by(told.value)
        assert len(first.result(60)) == 1
        assert len(other.result(60)) == 2


@pytest.mark.parametrize(
    "words",
    [
        "CUDA error: CUBLAS_STATUS_NOT_INITIALIZED when calling `cublasCreate(handle)`",
        "CUDA error: insufficient resources when calling `cusparseSpMM(handle)`",
        "CUDA error: out of memory",
    ],
)
def test_a_library_of_cuda_that_finds_no_room_is_full_memory(words):
    assert is_full_memory(RuntimeError(words))
