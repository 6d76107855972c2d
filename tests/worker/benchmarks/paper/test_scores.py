"""Scores of a trial, once for each content, and where pairs lie in the detector's own space."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.detectors import CountingDetector
from tests.worker.benchmarks.paper.test_experiments import NOTHING, ONE
from worker.benchmarks.methods import CachedDetector, open_model
from worker.benchmarks.paper.experiments import trials
from worker.benchmarks.paper.scores import outcomes_of, principal, scored_by_detector
from worker.benchmarks.paper.site import Site
from worker.cloud.tiling import TilePairs
from worker.detectors.card import MODEL_STORE
from worker.progress import no_progress


def test_only_tiles_with_new_points_are_scored_again(site: Site) -> None:
    detector = CountingDetector()
    carried_out = list(trials(site, [NOTHING, ONE, NOTHING], no_progress))
    method = scored_by_detector("counting", CachedDetector(detector=detector), carried_out)
    assert detector.encoded == 1
    assert detector.asked == [4, 4, 1]  # the first against the clock
    assert method.scores[0].tolist() == method.scores[2].tolist() == [0, 0, 0, 0]
    (tile,) = np.flatnonzero(carried_out[1].truth)
    expected = 1 - len(carried_out[1].pairs.current[tile]) / len(site.tiles.points[tile])
    assert expected > 0
    assert method.scores[1][tile] == pytest.approx(expected, abs=1e-6)


def test_a_detector_by_voxels_is_given_what_the_scans_saw(site: Site) -> None:
    carried_out = list(trials(site, [NOTHING, ONE], no_progress, seen=True))
    cached = CachedDetector(detector=open_model(MODEL_STORE, "voxel-rule/1"))
    method = scored_by_detector("voxel-rule/1", cached, carried_out)
    assert [len(scores) for scores in method.scores] == [4, 4]
    assert np.nan_to_num(method.scores[0]).max() < 0.5
    assert method.seconds > 0


def test_a_tile_that_was_not_observed_has_no_score(site: Site) -> None:
    (trial,) = trials(site, [NOTHING], no_progress)
    unseen = np.array([True, False, True, True])
    pairs = TilePairs(reference=trial.pairs.reference, current=trial.pairs.current, observed=unseen)
    score = CachedDetector(detector=CountingDetector()).score(pairs)
    assert np.isnan(score).tolist() == [False, True, False, False]


def test_outcomes_are_named_by_flag_and_truth() -> None:
    scores, truth = np.array([0.9, 0.9, 0.1, 0.1, np.nan]), np.array([True, False, True, False, True])
    assert outcomes_of(scores, truth, 0.5).tolist() == ["TP", "FP", "FN", "TN", "FN"]


def test_points_on_a_line_are_explained_by_one_direction() -> None:
    along = np.linspace(-1, 1, 21)
    places, explained = principal(np.outer(along, [3.0, 4.0, 0.0]))
    assert explained[0] == pytest.approx(1.0)
    assert np.abs(places[:, 0]) == pytest.approx(5 * np.abs(along), abs=1e-12)
