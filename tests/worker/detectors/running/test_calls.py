"""Batches that fit: cut to a size, halved where the memory does not suffice, and remembered."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch

from worker.detectors.running.calls import DirectBatches, FittedRuns, NetworkCall, device_answers
from worker.detectors.running.meter import Meter
from worker.errors import Cancelled, OutOfMemory


class Small:
    """A network that doubles numbers, in a device where so many items fit; notes its batches."""

    def __init__(self, fits: int = 1000, model: str = "small/1", most: int | None = None) -> None:
        self.fits = fits
        self.batches: list[list[int]] = []
        self.call = NetworkCall(
            model=model, function="double", fingerprint="f", run=self._run, size=lambda item: 1, most=most
        )

    def _run(self, items: Sequence[int]) -> list[int]:
        self.batches.append(list(items))
        if len(items) > self.fits:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return [2 * item for item in items]


def quietly(done: int) -> None:
    pass


def test_items_are_run_in_order_in_batches_of_at_most_so_many():
    small = Small()
    told: list[int] = []
    results = DirectBatches(FittedRuns(4)).run(small.call, range(10), told.append)
    assert results == [2 * item for item in range(10)]
    assert [len(batch) for batch in small.batches] == [4, 4, 2]
    assert told == [0, 4, 8, 10]


def test_a_call_may_ask_for_smaller_batches_and_not_for_larger_ones():
    for asked, sizes in ((2, [2, 2, 2]), (6, [4, 2])):
        small = Small(most=asked)
        DirectBatches(FittedRuns(4)).run(small.call, range(6), quietly)
        assert [len(batch) for batch in small.batches] == sizes


def test_a_large_item_counts_as_much_as_it_is_and_is_run_all_the_same():
    batches: list[list[int]] = []

    def run(items: Sequence[int]) -> Sequence[int]:
        batches.append(list(items))
        return items

    call = NetworkCall(model="m/1", function="f", fingerprint="", run=run, size=lambda item: item)
    DirectBatches(FittedRuns(4)).run(call, [1, 2, 9, 3, 1, 1], quietly)
    assert batches == [[1, 2], [9], [3, 1], [1]]


def test_a_batch_that_does_not_fit_is_halved_and_the_size_is_remembered():
    small, meter = Small(fits=3), Meter()
    fitted = FittedRuns(16, meter)
    assert fitted.run(small.call, range(16)) == [2 * item for item in range(16)]
    assert fitted.most(small.call) == 2
    small.batches.clear()
    DirectBatches(fitted).run(small.call, range(6), quietly)
    assert [len(batch) for batch in small.batches] == [2, 2, 2]
    assert meter.take()["out_of_memory", "small/1"][0] == 7  # of 16, twice 8, four times 4


def test_it_is_remembered_of_the_model_alone_also_when_that_is_opened_again():
    fitted = FittedRuns(16)
    fitted.run(Small(fits=3).call, range(16))
    assert fitted.most(Small(fits=3).call) == 2
    assert fitted.most(Small(model="other/1").call) == 16


def test_one_item_that_does_not_fit_is_an_error_and_the_others_have_their_results():
    fitted = FittedRuns(4)
    call = NetworkCall(model="m/1", function="f", fingerprint="", run=_all_but_three)
    first, second, third, fourth = fitted.run(call, [1, 2, 3, 4])
    assert (first, second, fourth) == (1, 2, 4)
    assert isinstance(third, OutOfMemory)
    with pytest.raises(OutOfMemory, match="m/1 needs more of the GPU's memory for one item than is free"):
        DirectBatches(fitted).run(call, [1, 2, 3, 4], quietly)


def _all_but_three(items: Sequence[int]) -> Sequence[int]:
    if 3 in items:
        raise torch.OutOfMemoryError("CUDA out of memory")
    return items


def _broken(items: Sequence[int]) -> Sequence[int]:
    raise RuntimeError("no number")


def test_other_errors_and_a_dismissal_pass():
    small = Small()
    broken = NetworkCall(model="m/1", function="f", fingerprint="", run=_broken)
    with pytest.raises(RuntimeError, match="no number"):
        DirectBatches().run(broken, [1], quietly)

    def dismissed(done: int) -> None:
        if done:
            raise Cancelled("dismissed")

    small.batches.clear()
    with pytest.raises(Cancelled):
        DirectBatches(FittedRuns(2)).run(small.call, range(6), dismissed)
    assert small.batches == [[0, 1]]


def test_what_was_counted_is_taken_once_and_can_be_given_back():
    meter = Meter()
    DirectBatches(FittedRuns(4, meter)).run(Small().call, range(6), quietly)
    counted = meter.take()
    assert counted["batch_size", "small/1"] == (2, 6.0)
    assert counted["batch_requests", "small/1"] == (2, 2.0)
    assert counted["network_seconds", "small/1"][0] == 2
    assert meter.take() == {}
    meter.give_back(counted)
    assert meter.take() == counted


@pytest.mark.parametrize(
    ("error", "answers"),
    [
        (torch.AcceleratorError("CUDA error: an illegal memory access was encountered"), False),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB"), True),
    ],
)
def test_a_device_answers_unless_it_fails_again_for_another_reason_than_room(monkeypatch, error, answers):
    def fails() -> None:
        raise error

    assert not device_answers()  # there is none here
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", fails)
    assert device_answers() is answers
