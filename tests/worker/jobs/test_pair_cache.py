"""The pairs that a build of a map keeps in the blob store, so that one that was killed goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from worker.jobs.pair_cache import StoredPairCache
from worker.pipeline.registration.scan_to_scan import PairResult

JOB = "job-1"


class Clock:
    """Seconds that pass when the test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def blobs(tmp_path: Path) -> Blobs:
    return Blobs((tmp_path / "blobs").as_uri())


@pytest.fixture
def clock() -> Clock:
    return Clock()


def pair(target: int, source: int, *, rmse: float = 0.02) -> PairResult:
    pose = np.eye(4)
    pose[:3, 3] = target, source, 0.1
    return PairResult(
        target=target,
        source=source,
        target_from_source=pose,
        fitness=0.9,
        inlier_rmse=rmse,
        overlap=0.8,
        two_way_inlier_ratio=0.95,
        free_space_violation=0.001,
        consistent_with_prior=True,
        accepted=bool(np.isfinite(rmse)),
        information=np.diag(np.arange(1.0, 7.0)) * 1e5,
    )


def loaded(blobs: Blobs, job_id: str = JOB) -> dict[tuple[int, int], PairResult]:
    return {(each.target, each.source): each for each in StoredPairCache(blobs, job_id).load()}


def writes(blobs: Blobs) -> int:
    return len(blobs.under(blob_keys.map_work(JOB)))


def test_a_new_build_remembers_nothing(blobs: Blobs) -> None:
    assert loaded(blobs) == {}


def test_pairs_come_back_as_they_were_those_that_met_nothing_too(blobs: Blobs) -> None:
    cache = StoredPairCache(blobs, JOB)
    saved = [pair(0, 1), pair(1, 2, rmse=np.inf)]
    cache.save(saved)
    cache.flush()
    found = loaded(blobs)
    assert set(found) == {(0, 1), (1, 2)}
    for each in saved:
        again = found[each.target, each.source]
        assert np.array_equal(again.target_from_source, each.target_from_source)
        assert np.array_equal(again.information, each.information)
        assert (again.inlier_rmse, again.accepted) == (each.inlier_rmse, each.accepted)


def test_pairs_within_two_seconds_of_a_write_wait_for_the_next(blobs: Blobs, clock: Clock) -> None:
    cache = StoredPairCache(blobs, JOB, clock=clock)
    for number in range(1, 20):
        clock.now += 0.25
        cache.save([pair(0, number)])
    # after 2, 4 seconds: the eighth and the sixteenth; the last three would be lost
    assert writes(blobs) == 2
    assert len(loaded(blobs)) == 16
    clock.now += 2
    cache.save([])
    assert len(loaded(blobs)) == 19


def test_nothing_new_writes_nothing(blobs: Blobs, clock: Clock) -> None:
    cache = StoredPairCache(blobs, JOB, clock=clock)
    for _ in range(5):
        clock.now += 10
        cache.save([])
    assert writes(blobs) == 0


def test_a_second_attempt_adds_to_the_first_and_neither_overwrites_the_other(
    blobs: Blobs, clock: Clock
) -> None:
    first, second = (StoredPairCache(blobs, JOB, clock=clock) for _ in range(2))
    for number, cache in enumerate((first, second, first)):  # the first was thought dead
        clock.now += 3
        cache.save([pair(0, number + 1)])
    assert set(loaded(blobs)) == {(0, 1), (0, 2), (0, 3)}


def test_each_build_has_its_own(blobs: Blobs, clock: Clock) -> None:
    other = StoredPairCache(blobs, "job-11", clock=clock)
    clock.now += 3
    other.save([pair(0, 1)])
    assert loaded(blobs) == {}
    assert len(loaded(blobs, "job-11")) == 1


def test_what_another_release_wrote_is_left_aside(blobs: Blobs, clock: Clock) -> None:
    cache = StoredPairCache(blobs, JOB, clock=clock)
    cache.save([pair(0, 1)])
    cache.flush()
    blobs.put_bytes(blob_keys.map_pairs(JOB, "old"), b'[{"target": 0, "source": 2}]')
    assert list(loaded(blobs)) == [(0, 1)]
