"""Models are kept open up to a bound; who is in use is not closed, and nobody is opened twice at once."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from worker.detectors.running.meter import Meter
from worker.detectors.running.warm import LEAST_BYTES, Held, WarmModels, weight_of
from worker.errors import DetectorUnavailable

MIB = 1 << 20


class Opened:
    """Opens models of so many MiB, and notes which."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def model(self, name: str, mib: int = 1) -> Any:
        def opened() -> Any:
            self.names.append(name)
            weights = {"w": torch.zeros(mib * MIB // 4)}
            return SimpleNamespace(card=SimpleNamespace(model=name), weights=lambda: weights)

        return name, opened


@pytest.fixture
def opened() -> Opened:
    return Opened()


def use(warm: WarmModels, model: Any) -> Any:
    with warm.borrow(*model) as detector:
        return detector


def test_a_model_is_opened_once_and_kept(opened):
    warm = WarmModels(8 * MIB)
    assert use(warm, opened.model("a")) is use(warm, opened.model("a"))
    assert opened.names == ["a"]
    assert warm.held == Held(models=1, bytes=MIB)


def test_who_was_used_longest_ago_is_closed_first(opened):
    meter = Meter()
    warm = WarmModels(3 * MIB, meter)
    for name in ("a", "b", "c", "a", "d"):
        use(warm, opened.model(name))
    assert warm.held == Held(models=3, bytes=3 * MIB)
    use(warm, opened.model("a"))
    assert opened.names == ["a", "b", "c", "d"]  # a was used after b, so b went
    use(warm, opened.model("b"))
    assert opened.names[-1] == "b"
    assert meter.take() == {
        ("models_opened", "a"): (1, 1.0),
        ("models_opened", "b"): (2, 2.0),
        ("models_opened", "c"): (1, 1.0),
        ("models_opened", "d"): (1, 1.0),
        ("models_evicted", "b"): (1, 1.0),
        ("models_evicted", "c"): (1, 1.0),
    }


def test_a_large_model_takes_the_room_of_several(opened):
    warm = WarmModels(4 * MIB)
    for name in ("a", "b", "c"):
        use(warm, opened.model(name))
    use(warm, opened.model("large", 3))
    assert warm.held == Held(models=2, bytes=4 * MIB)


def test_a_model_in_use_is_not_closed_and_goes_when_it_is_given_back(opened):
    warm = WarmModels(2 * MIB)
    with warm.borrow(*opened.model("a", 2)):
        with warm.borrow(*opened.model("b", 2)):
            assert warm.held == Held(models=2, bytes=4 * MIB)
            use(warm, opened.model("a", 2))
            assert opened.names == ["a", "b"]
        assert warm.held == Held(models=1, bytes=2 * MIB)  # b, which nobody has; a is in use
        assert use(warm, opened.model("a", 2))
    assert opened.names == ["a", "b"]


def test_a_model_that_is_larger_than_all_room_is_kept_while_it_is_used(opened):
    warm = WarmModels(MIB)
    with warm.borrow(*opened.model("large", 5)):
        assert warm.held.models == 1
    assert warm.held == Held()


def test_what_cannot_be_opened_is_tried_again(opened):
    def gone() -> Any:
        raise DetectorUnavailable("no weights")

    warm = WarmModels(4 * MIB)
    with pytest.raises(DetectorUnavailable), warm.borrow("a", gone):
        pass
    assert use(warm, opened.model("a"))


def test_an_error_within_gives_the_model_back(opened):
    warm = WarmModels(MIB)
    with pytest.raises(ZeroDivisionError), warm.borrow(*opened.model("a")):
        raise ZeroDivisionError
    use(warm, opened.model("b"))
    assert warm.held == Held(models=1, bytes=MIB)


def test_two_steps_that_need_the_same_model_open_it_once(opened):
    warm, go = WarmModels(4 * MIB), threading.Event()
    key, open_now = opened.model("a")

    def slowly() -> Any:
        assert go.wait(60)
        return open_now()

    with ThreadPoolExecutor(3) as pool:
        found = [pool.submit(use, warm, (key, slowly)) for _ in range(3)]
        go.set()
        assert len({id(one.result(60)) for one in found}) == 1
    assert opened.names == ["a"]


def test_a_detector_without_weights_counts_a_little():
    without: Any = SimpleNamespace(card=None)
    assert weight_of(without) == LEAST_BYTES
