"""Which pairs are registered, from ranks alone."""

from __future__ import annotations

import numpy as np

from worker.pipeline.map_settings import MapSettings
from worker.pipeline.pairing import PairPlan

SETTINGS = MapSettings(partners=1, searched_partners=2, partners_across=1)


def plan(pairs: dict[tuple[int, int], float], *, searched: tuple[tuple[int, int], ...] = ()) -> PairPlan:
    """Scans 0 to 5, with these ranks."""
    rank = np.zeros((6, 6))
    for (a, b), value in pairs.items():
        rank[a, b] = rank[b, a] = value
    return PairPlan(numbers=list(range(6)), rank=rank, starts={pair: (np.eye(4),) for pair in searched})


RANKS = {(0, 1): 0.9, (0, 2): 0.8, (1, 2): 0.7, (3, 4): 0.9, (2, 3): 0.3, (1, 4): 0.2}


def test_a_scan_with_a_prior_proposes_fewer_partners_than_one_that_was_searched() -> None:
    assert plan(RANKS).first(SETTINGS) == [(0, 1), (0, 2), (3, 4)]
    searched = plan(RANKS, searched=tuple(RANKS)).first(SETTINGS)
    assert {(0, 1), (0, 2), (1, 2), (2, 3)} < set(searched)


def test_between_parts_the_likeliest_pairs_are_named_and_none_within_a_part() -> None:
    assert plan(RANKS).across([(0, 1, 2), (3, 4), (5,)], [], SETTINGS) == [(1, 4), (2, 3)]


def test_a_pair_that_was_tried_is_not_named_again() -> None:
    assert plan(RANKS).across([(0, 1, 2), (3, 4), (5,)], [(2, 3)], SETTINGS) == [(1, 4)]


def test_scans_in_one_part_need_no_more_pairs() -> None:
    assert plan(RANKS).across([tuple(range(6))], [], SETTINGS) == []
