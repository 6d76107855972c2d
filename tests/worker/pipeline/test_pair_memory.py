"""A build that was killed begins again and is given what it had registered."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest
from rooms import Room
from visits import QUICK, off, placement, placing, written

from worker.errors import Cancelled
from worker.pipeline import pairing
from worker.pipeline.pair_memory import Forgetful, PairMemory
from worker.pipeline.pair_work import Pairing, Searching
from worker.pipeline.pairwise import PairResult
from worker.pipeline.placement import ScanFile
from worker.pipeline.placing import Placed, place_together

SETTINGS = placing(QUICK.model_copy(update={"search_resolutions": ()}))


class Kept:
    """A memory that forgets nothing."""

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
def registered(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The pairs that ICP was run on, in the order of the work."""
    pairs: list[tuple[int, int]] = []
    real = pairing.register_pairs

    def counted(task: Pairing) -> list[PairResult]:
        pairs.extend((task.target, number) for number, *_ in task.sources)
        return real(task)

    monkeypatch.setattr(pairing, "register_pairs", counted)
    return pairs


def build(files: tuple[ScanFile, ...], memory: PairMemory | None = None) -> Placed:
    return place_together(files, settings=SETTINGS, memory=memory, processes=1)


def assert_same_map(a: Placed, b: Placed) -> None:
    for one, other in zip(a.outcomes, b.outcomes, strict=True):
        assert off(placement(one).map_from_scan, placement(other).map_from_scan) < 1e-9
        assert placement(one).path == placement(other).path
    assert a.report == b.report


def test_a_second_build_registers_nothing_again_and_ends_in_the_same_poses(
    files: tuple[ScanFile, ...], registered: list[tuple[int, int]]
) -> None:
    memory = Kept()
    first = build(files, memory)
    assert len(registered) == len(memory.results) == first.report.pairs_tried > 3
    registered.clear()
    second = build(files, memory)
    assert registered == []
    assert_same_map(first, second)
    assert len(memory.results) == first.report.pairs_tried  # and nothing is kept twice


def test_a_build_goes_on_from_the_pairs_that_are_left(
    files: tuple[ScanFile, ...], registered: list[tuple[int, int]]
) -> None:
    memory = Kept()
    first = build(files, memory)
    every = set(registered)
    registered.clear()
    lost = memory.results.pop()
    assert_same_map(first, build(files, memory))
    assert registered == [(lost.target, lost.source)]
    assert {(each.target, each.source) for each in memory.results} == every


def test_a_build_that_is_stopped_between_two_targets_has_kept_what_it_had(
    files: tuple[ScanFile, ...], registered: list[tuple[int, int]]
) -> None:
    memory = Kept()

    def dismissed(stage: str, share: float) -> None:
        if stage == "registering" and share > 0:
            raise Cancelled("the job was dismissed")

    with pytest.raises(Cancelled):
        place_together(files, settings=SETTINGS, memory=memory, processes=1, progress=dismissed)
    begun = set(registered)
    assert {(each.target, each.source) for each in memory.results} == begun
    registered.clear()
    found = build(files, memory)
    assert begun.isdisjoint(registered)
    assert len(begun) + len(registered) == found.report.pairs_tried


def test_what_this_build_would_not_try_is_not_believed_because_it_is_remembered(
    files: tuple[ScanFile, ...], registered: list[tuple[int, int]]
) -> None:
    """The memory of four scans, given to a build of two."""
    memory = Kept()
    build(files, memory)
    registered.clear()
    few = build(files[:2], memory)
    assert registered == []
    assert few.report.pairs_tried == 1
    assert len(few.kept) == 1


def test_pairs_that_had_to_be_searched_are_remembered_too(
    room: Room,
    tmp_path: Path,
    registered: list[tuple[int, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[int] = []
    real = pairing.search

    def counted(task: Searching) -> object:
        searched.append(task.source)
        return real(task)

    monkeypatch.setattr(pairing, "search", counted)
    lost = tuple(written(tmp_path / f"{number}.pcd", room.before[number], thinned=6) for number in (0, 1))
    memory = Kept()
    first = build(lost, memory)
    assert registered == [(0, 1)]
    assert_same_map(first, build(lost, memory))
    assert registered == [(0, 1)]
    assert searched == [1, 1]  # each source in those before it, once a build


def test_the_forgetful_one_keeps_nothing() -> None:
    memory = Forgetful()
    memory.save([])
    assert list(memory.load()) == []
