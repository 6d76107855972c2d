"""Disturbances do what their names say."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worker.benchmarks.paper.test_experiments import ONE
from worker.benchmarks.paper.experiments import Trial, trials
from worker.benchmarks.paper.robustness import LEVELS, disturbed
from worker.benchmarks.paper.site import Site
from worker.progress import no_progress


@pytest.fixture
def trial(site: Site) -> Trial:
    return next(iter(trials(site, [ONE], no_progress)))


@pytest.mark.parametrize("what", LEVELS)
def test_the_first_level_of_each_disturbance_is_none(site: Site, trial: Trial, what: str) -> None:
    assert LEVELS[what][0] == 0
    assert disturbed(site, trial, what, 0) is trial.pairs


def test_jitter_of_ten_millimetres_is_ten_millimetres(site: Site, trial: Trial) -> None:
    found = disturbed(site, trial, "jitter (mm)", 10)
    off = np.concatenate(found.current) - np.concatenate(trial.pairs.current)
    assert off.std() == pytest.approx(0.010, rel=0.03)


def test_dropout_of_a_fifth_leaves_four_fifths(site: Site, trial: Trial) -> None:
    found = disturbed(site, trial, "dropout (%)", 20)
    before, after = (sum(map(len, pairs.current)) for pairs in (trial.pairs, found))
    assert after / before == pytest.approx(0.8, abs=0.01)


def test_a_translation_moves_every_point_along_the_floor(site: Site, trial: Trial) -> None:
    found = disturbed(site, trial, "translation (cm)", 5)
    middles = [np.concatenate(pairs.current).mean(axis=0) for pairs in (trial.pairs, found)]
    # what leaves the row of tiles at its borders is cut off, so the mean moves by less
    assert 0.01 < np.linalg.norm(middles[1] - middles[0]) < 0.051
    assert middles[1][2] == pytest.approx(middles[0][2], abs=0.002)


def test_a_yaw_about_the_middle_leaves_the_middle_and_moves_the_ends(site: Site, trial: Trial) -> None:
    found = disturbed(site, trial, "yaw (degrees)", 2)
    assert [len(points) for points in found.current] != [len(points) for points in trial.pairs.current]
    middle = np.concatenate(found.current).mean(axis=0)
    assert middle == pytest.approx(np.concatenate(trial.pairs.current).mean(axis=0), abs=0.03)


def test_a_disturbance_that_is_not_known_is_refused(site: Site, trial: Trial) -> None:
    with pytest.raises(ValueError, match="no disturbance fog"):
        disturbed(site, trial, "fog", 1)
