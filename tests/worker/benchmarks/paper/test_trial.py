"""The current map of a trial: the reference but for what was changed, and scored once for each content."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.worker.benchmarks.paper.test_injection import ONE
from worker.benchmarks.paper.scoring import CachedDetector, scored
from worker.benchmarks.paper.site import Site
from worker.benchmarks.paper.trial import trials
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays
from worker.detectors.card import Card, Preprocessing
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.progress import Progress, no_progress


class CountingDetector:
    """Says how much the number of points changed, and keeps count of the tiles it was asked about."""

    card = Card(
        name="counting",
        version="1",
        detector="counting",
        summary="",
        threshold=0.0,
        preprocessing=Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512),
    )

    def __init__(self) -> None:
        self.described = 0
        self.asked: list[int] = []

    def encode_reference(self, reference: Side, tiles: Tiles, *, progress: Progress = no_progress) -> Arrays:
        self.described += 1
        return {"counts": np.array([len(points) for points in tiles.points])}

    def detect(
        self, comparison: Comparison, *, embedding: Arrays | None = None, progress: Progress = no_progress
    ) -> Detection:
        assert embedding is not None
        pairs = comparison.tile_pairs
        self.asked.append(len(pairs.current))
        now = np.array([len(points) for points in pairs.current])
        share = np.abs(now - embedding["counts"]) / embedding["counts"]
        return Detection.of_scores(share)


NOTHING = replace(ONE, name="nothing", operation=None)


def test_without_changes_the_current_map_is_the_reference_bit_for_bit(site: Site) -> None:
    (trial,) = trials(site, [NOTHING], no_progress)
    for before, now in zip(site.tiles.points, trial.pairs.current, strict=True):
        assert np.array_equal(before, now)


def test_a_change_in_one_tile_leaves_the_others_bit_for_bit(site: Site) -> None:
    (trial,) = trials(site, [ONE], no_progress)
    same = [np.array_equal(*both) for both in zip(site.tiles.points, trial.pairs.current, strict=True)]
    assert np.array_equal(~np.array(same), trial.truth)
    assert trial.truth.sum() == 1


def test_a_removal_everywhere_leaves_fewer_voxels_than_one_in_a_single_scan(site: Site) -> None:
    (alone,), (everywhere,) = (
        list(trials(site, [ONE], no_progress, everywhere=all_)) for all_ in (False, True)
    )
    assert len(everywhere.current) < len(alone.current) < len(site.points)


def test_only_tiles_with_new_points_are_scored_again(site: Site) -> None:
    detector = CountingDetector()
    cached = CachedDetector(detector=detector, tiles=site.tiles)
    given = list(trials(site, [NOTHING, ONE, NOTHING], no_progress))
    found = scored("counting", lambda pairs: cached.score(pairs).astype(np.float64), given, 0.0)
    assert detector.described == 1
    assert detector.asked == [4, 1]
    assert found.scores[0].tolist() == found.scores[2].tolist() == [0, 0, 0, 0]
    (tile,) = np.flatnonzero(given[1].truth)
    expected = 1 - len(given[1].pairs.current[tile]) / len(site.tiles.points[tile])
    assert expected > 0
    assert found.scores[1][tile] == pytest.approx(expected, abs=1e-6)


def test_a_tile_that_was_not_observed_has_no_score(site: Site) -> None:
    (trial,) = trials(site, [NOTHING], no_progress)
    unseen = np.array([True, False, True, True])
    pairs = TilePairs(reference=trial.pairs.reference, current=trial.pairs.current, observed=unseen)
    score = CachedDetector(detector=CountingDetector(), tiles=site.tiles).score(pairs)
    assert np.isnan(score).tolist() == [False, True, False, False]
