"""C2C as a detector: a score that grows with the distance between the clouds, with no weights at all."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.tilings import ORIGIN, SIZE, grid_of
from worker.benchmarks.baselines import CloudToCloudBaseline as Baseline
from worker.cloud.tiling import TilePairs, TilingSettings, cut, pair_tiles
from worker.detectors.card import MODEL_STORE, Card
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.detectors.store import make_detector, open_card, open_detector, weights_of
from worker.errors import DetectorUnavailable, TrainingFailed


@pytest.fixture
def card() -> Card:
    return open_card(MODEL_STORE, "c2c/1")


def floor(height: float, *, x: float = 0.0, tiles: int = 2) -> np.ndarray:
    """A point every 2.5 cm of a floor in the first tiles of the row, so high above its lower side."""
    line = np.arange(0.0125, SIZE[0] * tiles, 0.025)
    across = line[line < SIZE[1]]
    flat = np.stack(np.meshgrid(line, across, [height], indexing="ij"), axis=-1).reshape(-1, 3)
    return (flat + ORIGIN + (x, 0, 0)).astype(np.float32)


def compared(reference: np.ndarray, current: np.ndarray) -> Comparison:
    tiles = cut(reference, grid_of(3, 1, 1), min_points=512)
    pairs = pair_tiles(tiles, current, settings=TilingSettings())
    return Comparison(reference=Side(points=reference), current=Side(points=current), tile_pairs=pairs)


def detection(card: Card, reference: np.ndarray, current: np.ndarray) -> Detection:
    return make_detector(card, None, "cpu").detect(compared(reference, current))


def test_the_shipped_model_opens_without_weights(card):
    assert (card.weights, card.sha256) == (None, None)
    detector = open_detector(MODEL_STORE, "c2c/1", "cpu")
    assert (
        detector.encode_reference(Side(points=floor(0.5)), cut(floor(0.5), grid_of(2, 1, 1), min_points=1))
        == {}
    )


def test_the_same_cloud_scores_0_and_an_unobserved_tile_nothing(card):
    found = detection(card, floor(0.5), floor(0.5, tiles=1))
    assert found.probabilities[0].tolist() == [1, 0, 0]
    assert np.isnan(found.probabilities[1]).all()


@pytest.mark.parametrize("metres", [0.01, 0.0607, 0.2])
def test_a_floor_raised_by_d_scores_d_over_d_and_the_half_distance(card, metres):
    half = card.detector_settings["half_distance"]
    found = detection(card, floor(0.3), floor(0.3 + metres))
    assert found.change == pytest.approx(metres / (metres + half), abs=1e-4)
    assert found.probabilities.sum(axis=1) == pytest.approx(1)


def test_the_threshold_of_the_card_is_the_half_distance(card):
    half = card.detector_settings["half_distance"]
    nearer, farther = (detection(card, floor(0.3), floor(0.3 + half + off)).change for off in (-1e-3, 1e-3))
    assert (nearer < card.threshold).all()
    assert (farther > card.threshold).all()


def test_what_was_removed_counts_as_what_was_added(card):
    box = floor(0.5, tiles=1)[:600]
    empty, full = floor(0.1), np.concatenate([floor(0.1), box])
    added, removed = (detection(card, *pair).change for pair in ((empty, full), (full, empty)))
    assert added == pytest.approx(removed, abs=1e-6)
    assert added[0] > 0.4
    assert added[1] == pytest.approx(0, abs=1e-6)


def test_the_border_of_a_tile_is_no_change(card):
    """The survey's points lie a hair over the border of a tile that the map has points on the other side of."""
    found = detection(card, floor(0.5), floor(0.5, x=0.0125))
    assert (found.change < 0.2).all()


def test_the_baseline_of_the_benchmarks_is_the_same_distance(card):
    pairs: TilePairs = compared(floor(0.3), floor(0.34)).tile_pairs
    distance = Baseline().score(pairs)
    change = make_detector(card, None, "cpu").detect(Comparison.of_tiles(pairs)).change
    half = card.detector_settings["half_distance"]
    assert change == pytest.approx(distance / (distance + half), abs=1e-6)


def test_an_unsound_setting_is_refused_by_its_name(card):
    odd = card.model_copy(update={"detector_settings": {"half_distance": -1}})
    with pytest.raises(DetectorUnavailable, match=r"c2c/1: detector_settings\.half_distance: "):
        make_detector(odd, None, "cpu")


def test_it_has_no_weights_to_train_further(card):
    with pytest.raises(TrainingFailed, match="c2c/1 cannot be trained further"):
        weights_of(make_detector(card, None, "cpu"))
