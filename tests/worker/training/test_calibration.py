"""The threshold, on scores whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from worker.training.calibration import PREVALENCE, area_under_roc, best_threshold, figures_at, survey_pairs
from worker.training.pairs import PairSettings


@pytest.fixture(scope="module")
def pairs(tiles):
    return survey_pairs(tiles, PairSettings(), seed=0)


def test_every_tile_is_paired_both_ways_once_unchanged_and_once_by_each_operation(tiles):
    pairs = survey_pairs(replace(tiles, observations=()), PairSettings(), seed=0)
    counts = {kind: pairs.kinds.count(kind) for kind in set(pairs.kinds)}
    assert counts == {"unchanged": 80, "add": 80, "remove": 80, "move": 80}
    assert pairs.decisive.all()


def test_observations_of_other_visits_are_paired_both_ways_too_and_rebuilt_ones_are_not(pairs):
    counts = {kind: pairs.kinds.count(kind) for kind in set(pairs.kinds)}
    assert counts == {"unchanged": 80 + 20, "whole": 20, "add": 80, "remove": 80, "move": 80}


def test_where_whole_things_changed_the_threshold_is_chosen_by_them_and_not_by_synthetic_changes(pairs):
    kinds = np.array(pairs.kinds)
    scores = np.select([kinds == "whole", kinds == "unchanged"], [0.9, 0.5], 0.1).astype(np.float32)
    chosen = best_threshold(scores, pairs)
    assert chosen.threshold == pytest.approx(0.7, abs=0.02)
    assert (chosen.f1, chosen.recall) == (1, 1)
    assert chosen.recall_by_kind == {"add": 0, "remove": 0, "move": 0, "whole": 1}


def test_perfect_scores_are_parted_in_the_middle_of_the_gap(pairs):
    scores = np.where(pairs.changed, 0.8, 0.2).astype(np.float32)
    chosen = best_threshold(scores, pairs)
    assert (chosen.f1, chosen.precision, chosen.recall, chosen.false_positive_rate) == (1, 1, 1, 0)
    assert chosen.threshold == pytest.approx(0.5, abs=0.02)
    assert area_under_roc(scores, pairs) == 1.0


def test_precision_is_for_the_stated_share_of_changed_tiles_by_hand(pairs):
    scores = pairs.changed.astype(np.float32)
    unchanged = np.flatnonzero(~pairs.changed)
    scores[unchanged[: len(unchanged) // 10]] = 1.0  # a tenth of the unchanged are flagged
    found = figures_at(0.5, scores, pairs)
    assert found.false_positive_rate == pytest.approx(0.1)
    assert found.precision == pytest.approx(PREVALENCE / (PREVALENCE + 0.1 * (1 - PREVALENCE)))


def test_scores_that_know_nothing_rank_as_often_right_as_wrong(pairs):
    assert area_under_roc(np.zeros(len(pairs.kinds), np.float32), pairs) == 0.5
