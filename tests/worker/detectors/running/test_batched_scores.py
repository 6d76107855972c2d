"""What a survey is told does not depend on what its tiles were batched with."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from tests.support.visits import compared, seen_by
from worker.cloud.tiling import TilePairs
from worker.detectors.card import MODEL_STORE, Card
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detection, Detector
from worker.detectors.running.calls import DirectBatches, FittedRuns
from worker.detectors.running.meter import Meter
from worker.detectors.running.runtime import Runtime
from worker.detectors.running.shared import SharedBatches
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.spicd_net.together import TogetherEncoder
from worker.detectors.store import open_detector
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

SURVEYS = 3


@contextmanager
def shared(
    meter: Meter, most: int, *, at_once: bool = False
) -> Iterator[Callable[[Detector, list[Comparison]], list[Detection]]]:
    """Detects in a thread each, in batches that are certain to have tiles of all: they wait for each other for ever."""
    batches = SharedBatches(FittedRuns(most, meter), wait_s=3600)

    def detect(detector: Detector, comparisons: list[Comparison]) -> list[Detection]:
        detector.run_with(Runtime(batches=batches, at_once=at_once))  # type: ignore[attr-defined]
        all_here = threading.Barrier(len(comparisons))

        def one(comparison: Comparison) -> Detection:
            with batches.expect(detector.card.model):
                all_here.wait(60)
                return detector.detect(comparison)

        with ThreadPoolExecutor(len(comparisons)) as pool:
            return [future.result(120) for future in [pool.submit(one, each) for each in comparisons]]

    yield detect


def surveys(pairs: TilePairs) -> list[Comparison]:
    """Three surveys of one map, each with other points in the tiles, and one of them with fewer tiles."""
    made = []
    for number in range(SURVEYS):
        current = tuple(points[number * 7 :] for points in pairs.current)
        observed = pairs.observed & (np.arange(5) != (4 if number == 1 else -1))
        made.append(
            Comparison.of_tiles(TilePairs(reference=pairs.reference, current=current, observed=observed))
        )
    return made


def differ(a: Detection, b: Detection) -> float:
    assert np.array_equal(np.isnan(a.change), np.isnan(b.change))
    return float(np.nanmax(np.abs(a.probabilities - b.probabilities)))


@pytest.mark.parametrize("at_once", [False, True], ids=["processor", "gpu"])
def test_a_survey_of_tiles_has_the_scores_that_it_has_alone(
    card: Card, network: SpicdNetwork, pairs: TilePairs, at_once: bool
) -> None:
    """To float rounding: 1e-5 of the scores of a network that tells the surveys apart by more than 1e-4."""
    detector = SpicdNet(card, network, torch.device("cpu"))
    if at_once:
        detector.run_with(Runtime(at_once=True))
    asked = surveys(pairs)
    alone = [detector.detect(one) for one in asked]
    assert differ(alone[0], SpicdNet(card, network, torch.device("cpu")).detect(asked[0])) < 1e-5
    meter = Meter()
    with shared(meter, most=64, at_once=at_once) as detect:
        together = detect(detector, asked)
    counted = meter.take()
    batches, steps = counted["batch_requests", card.model]
    assert steps > batches, "no batch had tiles of two surveys"
    for one, other in zip(alone, together, strict=True):
        assert differ(one, other) < 1e-5
    assert max(differ(alone[0], other) for other in alone[2:]) > 1e-4  # the surveys are told apart


def test_a_batch_that_does_not_fit_is_halved_and_the_scores_are_the_same(
    card: Card, network: SpicdNetwork, pairs: TilePairs, monkeypatch: pytest.MonkeyPatch
) -> None:
    detector = SpicdNet(card, network, torch.device("cpu"))
    comparison = surveys(pairs)[0]
    expected = detector.detect(comparison)
    detector.run_with(Runtime(batches=DirectBatches(FittedRuns(64, meter := Meter())), at_once=True))
    together = detector._encoder
    assert isinstance(together, TogetherEncoder)
    real, sizes = together.forward, list[int]()

    def small(points: torch.Tensor, centroids: torch.Tensor) -> torch.Tensor:
        sizes.append(len(points))
        if len(points) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return real(points, centroids)

    monkeypatch.setattr(together, "forward", small)
    assert differ(detector.detect(comparison), expected) < 1e-5
    assert sizes[:2] == [4, 2]
    assert set(sizes[sizes.index(1) + 4 :]) <= {1}  # the size that fits is remembered
    assert meter.take()["out_of_memory", card.model][0] > 0


def test_a_survey_of_voxels_has_the_scores_that_it_has_alone() -> None:
    scene = random_room(11)
    seen = [seen_by(visit(scene, 2, seed=seed)) for seed in range(4)]
    asked = [compared(seen[0], other) for other in seen[1:]]
    detector = open_detector(MODEL_STORE, "voxel-net/1", device="cpu")
    alone = [detector.detect(one) for one in asked]
    meter = Meter()
    with shared(meter, most=10_000) as detect:
        together = detect(detector, asked)
    batches, steps = meter.take()["batch_requests", "voxel-net/1"]
    assert steps > batches
    for one, other in zip(alone, together, strict=True):
        assert one.voxels is not None
        assert other.voxels is not None
        assert differ(one, other) < 1e-5
        assert np.abs(one.voxels.appeared - other.voxels.appeared).max() < 1e-5
        assert np.abs(one.voxels.disappeared - other.voxels.disappeared).max() < 1e-5
        assert one.voxels.appeared.max() > 0.1
