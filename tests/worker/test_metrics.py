"""Figures of detection, against counts made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from worker.metrics import (
    PAPER_SWEEP,
    Confusion,
    all_thresholds,
    best_f1,
    class_figures,
    confusion,
    pooled,
    precision_recall,
    roc,
    sweep,
)

#: Six tiles: two changed and flagged, one changed and missed, one flagged for nothing, two left alone.
SCORES = np.array([0.9, 0.6, 0.2, 0.7, 0.1, 0.3])
TRUTH = np.array([True, True, True, False, False, False])


def test_six_tiles_above_a_half_are_counted_as_by_hand() -> None:
    found = confusion(SCORES, TRUTH, 0.5)
    assert found == Confusion(true_positives=2, false_positives=1, false_negatives=1, true_negatives=2)
    assert found.precision == pytest.approx(2 / 3)
    assert found.recall == pytest.approx(2 / 3)
    assert found.f1 == pytest.approx(2 / 3)
    assert found.accuracy == pytest.approx(4 / 6)
    assert found.false_positive_rate == pytest.approx(1 / 3)


def test_the_aggregated_row_of_the_papers_table_5_follows_from_its_counts() -> None:
    found = Confusion(true_positives=232, false_positives=38, false_negatives=52, true_negatives=2086)
    figures = [found.precision, found.recall, found.f1, found.accuracy]
    assert np.round(figures, 3).tolist() == [0.859, 0.817, 0.838, 0.963]


def test_a_score_at_the_threshold_is_not_flagged() -> None:
    assert confusion(np.array([0.5]), np.array([True]), 0.5).false_negatives == 1


def test_tiles_not_observed_are_counted_apart() -> None:
    observed = np.array([True, True, False, True, False, True])
    found = confusion(SCORES, TRUTH, 0.5, observed)
    assert (found.false_negatives, found.true_negatives) == (0, 1)
    assert (found.unobserved, found.unobserved_changed) == (2, 1)


def test_a_changed_tile_without_a_score_is_missed() -> None:
    assert confusion(np.array([np.nan]), np.array([True]), 0.1).false_negatives == 1


def test_pooling_adds_the_counts_and_not_the_ratios() -> None:
    many = Confusion(true_positives=9, false_positives=1)
    few = Confusion(true_positives=0, false_positives=10, false_negatives=1, unobserved=2)
    assert pooled([many, few]).precision == pytest.approx(9 / 20)
    assert pooled([many, few]).unobserved == 2


def test_ratios_without_meaning_are_none_in_figures() -> None:
    figures = Confusion(true_negatives=172).figures()
    assert (figures["precision"], figures["recall"], figures["f1"]) == (None, None, None)
    assert figures["accuracy"] == 1.0
    assert figures["false_positive_rate"] == 0.0


def test_a_sweep_agrees_with_counting_at_each_threshold() -> None:
    rng = np.random.default_rng(1)
    scores, truth = np.round(rng.random(200), 2), rng.random(200) < 0.2
    scores[:5] = np.nan
    found = sweep(scores, truth)
    each = [confusion(scores, truth, threshold) for threshold in PAPER_SWEEP]
    assert found.true_positives.tolist() == [one.true_positives for one in each]
    assert found.false_positives.tolist() == [one.false_positives for one in each]
    assert found.f1 == pytest.approx([one.f1 for one in each])


def test_the_papers_sweep_goes_from_a_tenth_to_nine_tenths_in_hundredths() -> None:
    assert (PAPER_SWEEP[0], PAPER_SWEEP[7], PAPER_SWEEP[-1], len(PAPER_SWEEP)) == (0.1, 0.17, 0.9, 81)


def test_the_best_threshold_parts_separable_scores_and_lies_in_the_middle_of_the_gap() -> None:
    scores, truth = np.array([0.3, 0.35, 0.65, 0.7]), np.array([False, False, True, True])
    found = best_f1(scores, truth)
    assert found.counts.f1 == 1.0
    assert found.threshold == pytest.approx(0.5, abs=0.011)


def test_the_best_of_every_cut_may_lie_beyond_the_papers_sweep() -> None:
    scores, truth = np.array([0.01, 0.02, 0.05, 0.06]), np.array([False, False, True, True])
    assert best_f1(scores, truth).counts.f1 == 0.0
    assert best_f1(scores, truth, None).counts.f1 == 1.0
    assert best_f1(scores, truth, None).threshold == pytest.approx(0.035)


def test_no_threshold_is_chosen_where_nothing_changed() -> None:
    with pytest.raises(ValueError, match="no tile changed"):
        best_f1(SCORES, np.zeros(6, bool))


def test_every_cut_of_three_scores_is_four_thresholds() -> None:
    cuts = all_thresholds(np.array([0.2, np.nan, 0.4, 0.4, 0.8]))
    assert [int((np.array([0.2, 0.4, 0.8]) > cut).sum()) for cut in cuts] == [3, 2, 1, 0]


def test_the_area_under_roc_counts_ordered_pairs_and_halves_of_ties() -> None:
    # 0.9 beats all three, 0.6 beats 0.1 and 0.3, 0.2 beats 0.1: 6 of 9
    assert roc(SCORES, TRUTH).area == pytest.approx(6 / 9)
    tied = roc(np.array([0.5, 0.5]), np.array([True, False]))
    assert tied.area == pytest.approx(0.5)


def test_a_roc_begins_with_nothing_flagged_and_ends_with_everything() -> None:
    found = roc(SCORES, TRUTH)
    assert (found.false_positive_rate[0], found.recall[0]) == (0.0, 0.0)
    assert (found.false_positive_rate[-1], found.recall[-1]) == (1.0, 1.0)


def test_average_precision_of_six_tiles_is_that_by_hand() -> None:
    # by falling score: hit (1/1), alarm, hit (2/3), alarm, hit (3/5), alarm
    found = precision_recall(SCORES, TRUTH)
    assert found.average_precision == pytest.approx((1 + 2 / 3 + 3 / 5) / 3)
    assert found.recall[-1] == 1.0


def test_class_figures_of_a_known_confusion():
    answers = np.eye(3, dtype=np.float32)[[0, 0, 1, 1, 2, 0]]
    found = class_figures(answers, np.array([0, 0, 0, 1, 2, 2]), loss=0.5)
    assert found.accuracy == pytest.approx(4 / 6)
    assert found.precision == pytest.approx((2 / 3, 1 / 2, 1))
    assert found.recall == pytest.approx((2 / 3, 1, 1 / 2))
    assert found.rank == (found.accuracy, 0.5)
