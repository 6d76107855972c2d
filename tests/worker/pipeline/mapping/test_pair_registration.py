"""A build that was killed begins again and is given what it had registered."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from tests.support.rooms import Room
from tests.support.walks import QUICK, joint_settings, off, registered, written
from worker.errors import Cancelled
from worker.pipeline.mapping import pair_registration
from worker.pipeline.mapping.map_registration import MapRegistration, register_map_scans
from worker.pipeline.mapping.pair_registration import NullPairCache, PairCache, PairPlan
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.mapping.tasks import RegisterTask, SearchTask, register_pairs, search
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.registration.scan_to_scan import PairResult

SETTINGS = joint_settings(QUICK.model_copy(update={"search_resolutions": ()}))


class Kept:
    """A cache that forgets nothing."""

    def __init__(self, results: Iterable[PairResult] = ()) -> None:
        self.results = list(results)

    def load(self) -> Iterable[PairResult]:
        return tuple(self.results)

    def save(self, results: Iterable[PairResult]) -> None:
        self.results += results


@pytest.fixture(scope="module")
def files(room: Room, tmp_path_factory: pytest.TempPathFactory) -> tuple[ScanFile, ...]:
    folder = tmp_path_factory.mktemp("scans")
    return tuple(
        written(folder / f"{number}.pcd", scan, pose=scan.world_from_sensor, thinned=6)
        for number, scan in enumerate(room.before)
    )


@pytest.fixture
def icp_pairs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The pairs that ICP was run on, in the order of the work."""
    pairs: list[tuple[int, int]] = []

    def counted(task: RegisterTask) -> list[PairResult]:
        pairs.extend((task.target, number) for number, *_ in task.sources)
        return register_pairs(task)

    monkeypatch.setattr(pair_registration, "register_pairs", counted)
    return pairs


def build(files: tuple[ScanFile, ...], pair_cache: PairCache | None = None) -> MapRegistration:
    return register_map_scans(files, settings=SETTINGS, pair_cache=pair_cache, processes=1)


def assert_same_map(a: MapRegistration, b: MapRegistration) -> None:
    for one, other in zip(a.outcomes, b.outcomes, strict=True):
        assert off(registered(one).map_from_scan, registered(other).map_from_scan) < 1e-9
        assert registered(one).path == registered(other).path
    assert a.report == b.report


def test_a_second_build_registers_nothing_again_and_ends_in_the_same_poses(
    files: tuple[ScanFile, ...], icp_pairs: list[tuple[int, int]]
) -> None:
    cache = Kept()
    first = build(files, cache)
    assert len(icp_pairs) == len(cache.results) == first.report.pairs_tried > 3
    icp_pairs.clear()
    second = build(files, cache)
    assert icp_pairs == []
    assert_same_map(first, second)
    assert len(cache.results) == first.report.pairs_tried  # and nothing is kept twice


def test_a_build_goes_on_from_the_pairs_that_are_left(
    files: tuple[ScanFile, ...], icp_pairs: list[tuple[int, int]]
) -> None:
    cache = Kept()
    first = build(files, cache)
    every = set(icp_pairs)
    icp_pairs.clear()
    lost = cache.results.pop()
    assert_same_map(first, build(files, cache))
    assert icp_pairs == [(lost.target, lost.source)]
    assert {(each.target, each.source) for each in cache.results} == every


def test_a_build_that_is_stopped_between_two_targets_has_kept_what_it_had(
    files: tuple[ScanFile, ...], icp_pairs: list[tuple[int, int]]
) -> None:
    cache = Kept()

    def dismissed(stage: str, share: float) -> None:
        if stage == "registering" and share > 0:
            raise Cancelled("the job was dismissed")

    with pytest.raises(Cancelled):
        register_map_scans(files, settings=SETTINGS, pair_cache=cache, processes=1, progress=dismissed)
    begun = set(icp_pairs)
    assert {(each.target, each.source) for each in cache.results} == begun
    icp_pairs.clear()
    found = build(files, cache)
    assert begun.isdisjoint(icp_pairs)
    assert len(begun) + len(icp_pairs) == found.report.pairs_tried


def test_what_this_build_would_not_try_is_not_believed_because_it_is_remembered(
    files: tuple[ScanFile, ...], icp_pairs: list[tuple[int, int]]
) -> None:
    """The cache of four scans, given to a build of two."""
    cache = Kept()
    build(files, cache)
    icp_pairs.clear()
    few = build(files[:2], cache)
    assert icp_pairs == []
    assert few.report.pairs_tried == 1
    assert len(few.kept) == 1


def test_pairs_that_had_to_be_searched_are_remembered_too(
    room: Room,
    tmp_path: Path,
    icp_pairs: list[tuple[int, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[int] = []

    def counted(task: SearchTask) -> object:
        searched.append(task.source)
        return search(task)

    monkeypatch.setattr(pair_registration, "search", counted)
    lost = tuple(written(tmp_path / f"{number}.pcd", room.before[number], thinned=6) for number in (0, 1))
    cache = Kept()
    first = build(lost, cache)
    assert icp_pairs == [(0, 1)]
    assert_same_map(first, build(lost, cache))
    assert icp_pairs == [(0, 1)]
    assert searched == [1, 1]  # each source in those before it, once a build


def test_the_null_cache_keeps_nothing() -> None:
    cache = NullPairCache()
    cache.save([])
    assert list(cache.load()) == []


SELECTION = MappingSettings(partners=1, searched_partners=2, partners_across=1)


def plan(pairs: dict[tuple[int, int], float], *, searched: tuple[tuple[int, int], ...] = ()) -> PairPlan:
    """Scans 0 to 5, with these ranks."""
    rank = np.zeros((6, 6))
    for (a, b), value in pairs.items():
        rank[a, b] = rank[b, a] = value
    return PairPlan(indices=list(range(6)), rank=rank, starts={pair: (np.eye(4),) for pair in searched})


RANKS = {(0, 1): 0.9, (0, 2): 0.8, (1, 2): 0.7, (3, 4): 0.9, (2, 3): 0.3, (1, 4): 0.2}


def test_a_scan_with_a_prior_proposes_fewer_partners_than_one_that_was_searched() -> None:
    assert plan(RANKS).first(SELECTION) == [(0, 1), (0, 2), (3, 4)]
    searched = plan(RANKS, searched=tuple(RANKS)).first(SELECTION)
    assert {(0, 1), (0, 2), (1, 2), (2, 3)} < set(searched)


def test_between_parts_the_likeliest_pairs_are_named_and_none_within_a_part() -> None:
    assert plan(RANKS).across([(0, 1, 2), (3, 4), (5,)], [], SELECTION) == [(1, 4), (2, 3)]


def test_a_pair_that_was_tried_is_not_named_again() -> None:
    assert plan(RANKS).across([(0, 1, 2), (3, 4), (5,)], [(2, 3)], SELECTION) == [(1, 4)]


def test_scans_in_one_part_need_no_more_pairs() -> None:
    assert plan(RANKS).across([tuple(range(6))], [], SELECTION) == []
