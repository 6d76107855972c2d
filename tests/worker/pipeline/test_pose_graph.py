from __future__ import annotations

import numpy as np
import pytest
from graphs import along, around, edge, line, ring, shifted

from worker.pipeline.map_settings import MapSettings
from worker.pipeline.pose_graph import (
    chained,
    components,
    most_reliable_tree,
    reference_of,
    reliability,
    triangle_counts,
)
from worker.pipeline.poses import inverse

SETTINGS = MapSettings()
TRUTH = line(8)
DOUBTFUL = {"agreement": 0.84, "seen_through": 0.003}


def test_the_largest_component_comes_first_and_of_equal_ones_that_with_the_lowest_index() -> None:
    edges = [edge(TRUTH, 4, 6), edge(TRUTH, 0, 7), edge(TRUTH, 2, 3), edge(TRUTH, 3, 5)]
    assert components(range(8), edges) == [(2, 3, 5), (0, 7), (4, 6), (1,)]


def test_scans_without_any_registration_are_components_of_their_own() -> None:
    assert components([5, 2], []) == [(2,), (5,)]


def test_the_reference_is_the_scan_with_the_most_registrations() -> None:
    edges = [edge(TRUTH, 0, 2), edge(TRUTH, 1, 2), edge(TRUTH, 2, 3, fitness=0.1), edge(TRUTH, 0, 1)]
    assert reference_of(range(4), edges) == 2


def test_of_scans_with_as_many_registrations_the_reference_is_that_of_highest_mean_fitness() -> None:
    edges = [edge(TRUTH, 0, 1, fitness=0.6), edge(TRUTH, 1, 2, fitness=0.9), edge(TRUTH, 0, 2, fitness=0.7)]
    assert reference_of(range(3), edges) == 2  # 0.8 beside 0.65 and 0.75


def test_of_scans_that_are_equal_in_all_the_first_is_the_reference() -> None:
    assert reference_of([3, 1, 2], []) == 1


def test_a_chain_gives_the_known_poses_and_names_the_scans_on_the_way() -> None:
    found = chained(range(8), along(TRUTH, reach=1, noise=False), SETTINGS)
    assert found.reference == 1
    assert found.paths[6] == (1, 2, 3, 4, 5, 6)
    assert found.paths[0] == (1, 0)
    assert found.paths[1] == (1,)
    for number, pose in found.poses.items():
        assert pose == pytest.approx(inverse(TRUTH[1]) @ TRUTH[number], abs=1e-9)


def test_a_path_takes_fewer_registrations_where_all_can_be_relied_on() -> None:
    found = chained(range(6), around(ring(6), noise=False), SETTINGS)
    assert found.reference == 0
    assert {number: len(path) - 1 for number, path in found.paths.items()} == {
        0: 0, 1: 1, 2: 1, 3: 2, 4: 1, 5: 1,
    }  # fmt: skip


def test_a_path_goes_round_a_doubtful_registration() -> None:
    sure = [edge(TRUTH, a, b) for a, b in ((0, 1), (1, 2), (2, 3), (0, 4), (0, 5), (0, 6))]
    found = chained(range(7), [*sure, edge(TRUTH, 0, 3)], SETTINGS)
    assert found.paths[3] == (0, 3)
    found = chained(range(7), [*sure, edge(TRUTH, 0, 3, **DOUBTFUL)], SETTINGS)
    assert found.paths[3] == (0, 1, 2, 3)


def test_where_there_is_but_a_doubtful_registration_a_path_takes_one_not_two() -> None:
    edges = [
        *(edge(TRUTH, 0, number) for number in (1, 2, 5)),
        *(edge(TRUTH, a, b, **DOUBTFUL) for a, b in ((1, 3), (3, 4), (2, 4))),
    ]
    found = chained(range(6), edges, SETTINGS)
    assert found.paths[4] == (0, 2, 4)
    assert found.paths[3] == (0, 1, 3)


def test_the_tree_of_what_can_be_relied_on_takes_a_long_way_round() -> None:
    """The reference of this ring is scan 0; the edge back to it is a little less sure than all the others."""
    truth = ring(6)
    edges = [edge(truth, number, number + 1) for number in range(5)]
    edges += [edge(truth, 0, 5, agreement=0.93), edge({**truth, 6: truth[0]}, 0, 6)]
    assert most_reliable_tree(range(7), edges, SETTINGS).paths[5] == (0, 1, 2, 3, 4, 5)
    assert chained(range(7), edges, SETTINGS).paths[5] == (0, 5)


def test_a_triangle_that_closes_counts_for_its_three_registrations_and_one_that_does_not_against_them() -> (
    None
):
    edges = [edge(TRUTH, 0, 1), edge(TRUTH, 1, 2), edge(TRUTH, 0, 2), edge(TRUTH, 2, 3)]
    closing, open_ = triangle_counts(edges, SETTINGS)
    assert (closing.tolist(), open_.tolist()) == ([1, 1, 1, 0], [0, 0, 0, 0])
    astray = [*edges[:2], edge(TRUTH, 0, 2, error=shifted(0.2)), edges[3]]
    closing, open_ = triangle_counts(astray, SETTINGS)
    assert (closing.tolist(), open_.tolist()) == ([0, 0, 0, 0], [1, 1, 1, 0])


@pytest.mark.parametrize(
    ("error", "closes"),
    [
        (shifted(0.09), True),
        (shifted(0.11), False),
        (shifted(yaw=np.radians(1.4)), True),
        (shifted(yaw=np.radians(1.6)), False),
    ],
)
def test_a_triangle_closes_within_ten_centimetres_and_a_degree_and_a_half(
    error: np.ndarray, closes: bool
) -> None:
    """The frame of the error is that of a scan in the triangle's own corner, so that the turn moves nothing else."""
    truth = {number: shifted(yaw=0.3 * number) for number in range(3)}
    edges = [edge(truth, 0, 1), edge(truth, 1, 2), edge(truth, 0, 2, error=error)]
    assert triangle_counts(edges, SETTINGS)[0].tolist() == [float(closes)] * 3


def test_a_triangle_closes_whichever_scan_is_the_target() -> None:
    """A cycle 0 <- 1 <- 2 <- 0: the last registration is told the other way round."""
    edges = [edge(TRUTH, 0, 1), edge(TRUTH, 1, 2), edge(TRUTH, 2, 0)]
    assert triangle_counts(edges, SETTINGS)[0].tolist() == [1, 1, 1]


def test_reliability_grows_with_triangles_that_close_and_falls_with_those_that_do_not() -> None:
    alone = reliability([edge(TRUTH, 0, 1)], SETTINGS)[0]
    triangle = [edge(TRUTH, 0, 1), edge(TRUTH, 1, 2), edge(TRUTH, 0, 2)]
    vouched = reliability(triangle, SETTINGS)[0]
    contradicted = reliability([*triangle[:2], edge(TRUTH, 0, 2, error=shifted(1.0))], SETTINGS)[0]
    assert contradicted < alone < vouched
