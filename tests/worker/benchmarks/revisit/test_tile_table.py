"""Tiles of several visits side by side, and the groups that figures are taken over."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.tile_table import binned, tile_table


@pytest.fixture
def table(made_visit):
    plans = plan_visits(3, RevisitSettings(kinds=("office",)), first_seed=1)
    visits = [
        made_visit(plans[0].name, cells=[[50, 0, 0], [0, 0, 60], [5, 0, 0]], misfit=[0.0, 0.01, np.nan]),
        made_visit(plans[1].name, cells=[[0, 80, 0]], observed=[False]),
        made_visit(plans[2].name, cells=[[0, 0, 0]], misfit=[0.3]),
    ]
    return tile_table(plans, visits)


def test_tiles_stand_visit_after_visit(table):
    assert table.visit.tolist() == [0, 0, 0, 1, 2]
    assert table.case.tolist() == ["changed"] * 3 + ["sparse", "unchanged"]
    assert table.changed.tolist() == [True, True, False, True, False]
    assert table.counted.tolist() == [True, True, True, False, True]
    assert table.slight.tolist() == [False, False, True, False, False]


def test_groups_by_kind_hold_changed_tiles_only(table):
    kinds = {name: np.flatnonzero(tiles).tolist() for name, tiles in table.groups()["kind"].items()}
    assert kinds == {"add": [0], "remove": [3], "move": [1]}


def test_groups_by_case_and_building_hold_every_tile_once(table):
    for by in ("case", "building"):
        assert sum(tiles.astype(int) for tiles in table.groups()[by].values()).tolist() == [1] * 5


def test_a_bin_holds_its_lower_edge_and_what_is_not_known_lies_in_none():
    bins = binned(np.array([0.0, 0.0025, 0.00499, 0.01, 0.5, np.nan]))
    assert {name: np.flatnonzero(tiles).tolist() for name, tiles in bins.items()} == {
        "0 to 0.25 cm": [0],
        "0.25 to 0.5 cm": [1, 2],
        "0.5 to 1 cm": [],
        "1 to 2 cm": [3],
        "over 2 cm": [4],
    }
