from __future__ import annotations

import numpy as np

from worker.benchmarks.placement.fit import fit_table, fitted


def test_a_line_tells_poses_apart_by_the_share_that_differs_and_ignores_the_others() -> None:
    rng = np.random.default_rng(0)
    right = np.arange(400) % 2 == 0
    rows = rng.uniform(0, 0.2, (400, 7))
    rows[:, 2] = np.where(right, rng.uniform(0, 0.05, 400), rng.uniform(0.2, 0.5, 400))
    line = fitted(rows, right)
    odds = np.array([line.log_odds(row) for row in rows])
    assert (odds[right] > 0).all()
    assert (odds[~right] < 0).all()
    assert int(np.argmin(line.weights)) == 2
    assert max(line.weights) <= 0


def test_no_share_speaks_for_a_pose_even_where_right_ones_have_more_of_it() -> None:
    rng = np.random.default_rng(1)
    right = np.arange(200) % 2 == 0
    rows = rng.uniform(0, 0.2, (200, 7))
    rows[:, 0] = np.where(right, 0.5, 0.1)
    assert fitted(rows, right).weights[0] == 0


def test_the_table_shows_the_line_and_the_poses() -> None:
    result = {
        "bias": 1.0,
        "weights": [-1.0] * 7,
        "right": 3,
        "wrong": 4,
        "trials": 2,
        "right_log_odds": [0.0] * 4,
        "wrong_log_odds": [0.0] * 4,
    }
    assert fit_table(result).row_count == 5
