"""SPICD-Net as a detector: cached or not, distinct or padded, the scores are the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worker.detectors.spicd_net.detector import SpicdNet
from worker.errors import Cancelled


@pytest.fixture
def detector(card, network) -> SpicdNet:
    return SpicdNet(card, network, torch.device("cpu"))


def test_scores_are_probabilities_where_observed_and_nan_elsewhere(detector, pairs):
    scores = detector.score(pairs)
    assert scores.probabilities.shape == (5, 3)
    assert scores.probabilities.dtype == np.float32
    assert np.isnan(scores.probabilities).all(axis=1).tolist() == [False, False, True, False, False]
    assert scores.probabilities[pairs.observed].sum(axis=1) == pytest.approx(1, abs=1e-5)


def test_a_kept_description_gives_the_same_scores(detector, pairs):
    description = detector.describe(pairs.reference)
    assert {name: array.shape for name, array in description.items()} == {"descriptors": (5, 1024)}
    kept, fresh = detector.score(pairs, description=description), detector.score(pairs)
    assert np.array_equal(kept.probabilities, fresh.probabilities, equal_nan=True)


def test_distinct_points_give_the_scores_of_the_padded_patch(detector, pairs):
    distinct, padded = detector.score(pairs), detector.score(pairs, padded=True)
    assert distinct.probabilities == pytest.approx(padded.probabilities, abs=1e-4, nan_ok=True)
    assert np.nanstd(distinct.change) > 1e-4  # the tiles are told apart, so that equality says something


@pytest.mark.parametrize("chamfer_points", [None, 128])
def test_a_survey_that_finds_the_same_points_differs_by_nothing_but_the_sample(
    card, network, pairs, chamfer_points
):
    """All points of equal tiles are at distance 0; two samples of them are not, and the scores say so."""
    needs = card.preprocessing.model_copy(update={"chamfer_points": chamfer_points})
    detector = SpicdNet(card.model_copy(update={"preprocessing": needs}), network, torch.device("cpu"))
    same = type(pairs)(reference=pairs.reference, current=pairs.reference.points, observed=pairs.observed)
    statistics = detector.statistics(same)[pairs.observed]
    assert (statistics == 0).all() == (chamfer_points is None)
    assert statistics.max() < 0.5


def test_a_sample_larger_than_the_patch_is_refused(card, network):
    needs = card.preprocessing.model_copy(update={"chamfer_points": card.preprocessing.patch_points + 1})
    with pytest.raises(ValueError, match="Chamfer sample"):
        SpicdNet(card.model_copy(update={"preprocessing": needs}), network, torch.device("cpu"))


def test_a_description_of_another_map_is_refused(detector, pairs):
    description = {name: array[:4] for name, array in detector.describe(pairs.reference).items()}
    with pytest.raises(ValueError, match="another map or model"):
        detector.score(pairs, description=description)


def test_progress_rises_to_one_and_may_cancel(detector, pairs):
    reports: list[tuple[str, float]] = []
    detector.score(pairs, progress=lambda stage, share: reports.append((stage, share)))
    shares = [share for stage, share in reports if stage == "score"]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0

    def dismissed(stage: str, share: float) -> None:
        raise Cancelled("dismissed")

    with pytest.raises(Cancelled):
        detector.describe(pairs.reference, progress=dismissed)


def test_no_observed_tile_is_no_error(detector, pairs):
    nothing = type(pairs)(reference=pairs.reference, current=pairs.current, observed=np.zeros(5, dtype=bool))
    assert np.isnan(detector.score(nothing).probabilities).all()
