"""Models are kept open up to a bound; who is in use is not closed, and nobody is opened twice at once."""

from __future__ import annotations

import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests.support.detectors import CountingDetector
from worker.detectors.card import MODEL_STORE, Card
from worker.detectors.running.meter import Meter
from worker.detectors.running.runtime import Runtime
from worker.detectors.running.warm import LEAST_BYTES, Held, Lease, WarmModels, weight_of
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.store import open_detector
from worker.errors import DetectorUnavailable, OutOfMemory

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


def test_a_model_that_does_not_fit_is_opened_once_more_with_the_idle_ones_closed(opened):
    warm, tries = WarmModels(99 * MIB), list[int]()

    def large() -> Any:
        tries.append(warm.held.models)
        if warm.held.models > 1:
            raise OutOfMemory("model large needs more of the GPU's memory than is free")
        return opened.model("large")[1]()

    with warm.borrow(*opened.model("used")):
        use(warm, opened.model("idle"))
        use(warm, ("large", large))
        assert tries == [2, 1]
        assert warm.held.models == 2
    with warm.borrow(*opened.model("used")), warm.borrow(*opened.model("too")):
        with pytest.raises(OutOfMemory, match="model large needs"):
            use(warm, ("large once more", large))
        assert warm.held.models == 2  # those in use


@pytest.mark.parametrize("model", ["spicd-net/1", "voxel-net/1", "pointnet2/1"])
def test_a_model_that_is_closed_is_gone_at_once(model):
    warm = WarmModels(1 << 30)
    with warm.borrow(model, lambda: open_detector(MODEL_STORE, model, "cpu", Runtime())) as detector:
        seen = weakref.ref(detector)
        del detector
    gc.collect()
    gc.disable()
    try:
        warm._close_idle(0)
        assert seen() is None
    finally:
        gc.enable()


def test_who_is_left_without_giving_back_has_the_model_no_more():
    """As a step that an error from outside is raised in, just where it should have counted itself out."""
    warm = WarmModels(1 << 30)
    block = warm.borrow("m/1", CountingDetector)
    block.__enter__()
    warm._close_idle(0)
    assert warm.held.models == 1
    warm._models["m/1"].lend(lease := Lease())
    del block
    warm._close_idle(0)
    assert warm.held.models == 1
    del lease
    warm._close_idle(0)
    assert warm.held.models == 0


@pytest.mark.parametrize("at_once", [False, True])
def test_weights_that_are_kept_a_second_time_count_twice(card: Card, network: SpicdNetwork, at_once: bool):
    detector = SpicdNet(card, network, torch.device("cpu"))
    detector.run_with(Runtime(at_once=at_once))
    once = sum(tensor.nbytes for tensor in network.state_dict().values())
    encoder = sum(tensor.nbytes for tensor in network.encoder.state_dict().values())
    # all but the matrices of the T-Nets, which both share, and the figures of the normalisation
    shared = sum(
        tensor.nbytes
        for net in (network.encoder.input_transform, network.encoder.feature_transform)
        for tensor in net.matrix.state_dict().values()
    )
    assert weight_of(detector) == pytest.approx(once + encoder - shared, rel=0.01)
