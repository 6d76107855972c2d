"""Which tiles count, and that a visit comes back from disk as it went."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from worker.benchmarks.revisit import record


def test_a_tile_is_changed_from_forty_cells_of_all_kinds_together(made_visit):
    visit = made_visit(cells=[[39, 0, 0], [20, 0, 20], [0, 0, 0]])
    assert visit.exists.tolist() == [False, True, False]
    assert visit.kinds.tolist() == [record.NOTHING, 0, record.NOTHING]


def test_the_kind_is_that_of_most_cells(made_visit):
    assert made_visit(cells=[[30, 50, 40]]).kinds.tolist() == [1]


def test_a_change_out_of_sight_counts_neither_way_and_neither_does_an_unobserved_tile(made_visit):
    visit = made_visit(
        cells=[[50, 0, 0], [50, 0, 0], [50, 0, 0], [0, 0, 0]],
        in_sight=[[50, 0, 0], [10, 0, 0], [50, 0, 0], [0, 0, 0]],
        observed=[True, True, False, True],
    )
    assert visit.changed.tolist() == [True, False, True, False]
    assert visit.counted.tolist() == [True, False, False, True]


def test_a_visit_comes_back_from_disk(made_visit, tmp_path: Path):
    visit = made_visit(cells=[[50, 0, 0], [0, 7, 0]], misfit=[0.01, np.nan], outside=3)
    assert not record.kept(visit.name, tmp_path)
    record.save(visit, tmp_path)
    assert record.kept(visit.name, tmp_path)
    again = record.load(visit.name, tmp_path)
    assert again.name == visit.name
    assert again.outside == 3
    assert (again.second.scans, again.second.accepted) == (2, 1)
    for name in ("cells", "in_sight", "misfit", "sigma"):
        assert np.array_equal(getattr(again, name), getattr(visit, name), equal_nan=True)
    assert [part.tolist() for part in again.pairs.current] == [part.tolist() for part in visit.pairs.current]
    assert again.pairs.reference.indices.tolist() == visit.pairs.reference.indices.tolist()
