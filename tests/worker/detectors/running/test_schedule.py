"""Whose items go into the next batch."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from worker.detectors.running.calls import FittedRuns, NetworkCall
from worker.detectors.running.schedule import Request, Schedule


def call_of(model: str) -> NetworkCall[str, str]:
    return NetworkCall(model=model, function="encode", fingerprint="", run=list)


@pytest.mark.parametrize("items", [1, 3, 50])
def test_steps_that_ask_again_at_once_have_equal_shares_whatever_else_is_asked_for(items: int) -> None:
    """Two steps of each of two models, and batches that hold one item."""
    schedule = Schedule(FittedRuns(1), 0.0, lambda: 0.0)
    calls = {model: call_of(model) for model in ("a/1", "b/1")}
    names: dict[Any, str] = {}

    def ask(name: str) -> None:
        request = Request(calls[f"{name[0]}/1"], [name] * items, 0.0)
        names[request] = name
        schedule.add(request)

    for name in ("a first", "a second", "b first", "b second"):
        ask(name)
    served: Counter[str] = Counter()
    for _ in range(400):
        assert schedule.left_s() == 0.0
        for request, _ in schedule.take():
            served[names[request]] += 1
            if not request.waiting:
                ask(names[request])
    assert set(served.values()) == {100}
