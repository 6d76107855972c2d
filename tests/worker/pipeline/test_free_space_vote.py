"""Two lines of scans that agree within themselves, laid over each other by a registration that is wrong."""

from __future__ import annotations

from graphs import along, edge, line, shifted

from worker.pipeline.free_space_vote import Contradiction, most_accused
from worker.pipeline.map_settings import MapSettings
from worker.pipeline.pairwise import PairResult

SETTINGS = MapSettings()


def two_lines() -> tuple[list[int], list[PairResult], PairResult]:
    """Scans 0 to 4 and 5 to 9, each a line, and the edge 2-7 that ties them."""
    truth = line(5)
    second = {number + 5: pose for number, pose in line(5).items()}
    bridge = edge(truth | second, 2, 7, error=shifted(0.5), agreement=0.88)
    return [*truth, *second], [*along(truth), *along(second), bridge], bridge


def seen_through(*pairs: tuple[int, int]) -> list[Contradiction]:
    return [Contradiction(target=a, source=b, share=0.03) for a, b in pairs]


def test_the_edge_between_groups_that_contradict_each_other_is_accused() -> None:
    scans, edges, bridge = two_lines()
    found = seen_through((0, 5), (1, 6), (3, 8), (4, 9))
    assert most_accused(scans, edges, found, SETTINGS) is bridge


def test_a_contradiction_within_a_group_accuses_no_edge_between_groups() -> None:
    scans, edges, bridge = two_lines()
    accused = most_accused(scans, edges, seen_through((0, 4)), SETTINGS)
    assert accused is not None
    assert accused is not bridge


def test_the_more_doubtful_of_two_edges_on_a_path_is_accused() -> None:
    truth = line(4)
    sure, doubtful = edge(truth, 0, 1), edge(truth, 1, 2, agreement=0.86, seen_through=0.001)
    edges = [sure, doubtful, edge(truth, 2, 3)]
    assert most_accused(list(truth), edges, seen_through((0, 3)), SETTINGS) is doubtful


def test_without_a_contradiction_nobody_is_accused() -> None:
    scans, edges, _ = two_lines()
    assert most_accused(scans, edges, [], SETTINGS) is None
