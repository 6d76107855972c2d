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
    assert {name: array.shape for name, array in description.items()} == {
        "descriptors": (5, 1024),
        "samples": (5, 128, 3),
    }
    kept, fresh = detector.score(pairs, description=description), detector.score(pairs)
    assert np.array_equal(kept.probabilities, fresh.probabilities, equal_nan=True)


def test_distinct_points_give_the_scores_of_the_padded_patch(detector, pairs):
    distinct, padded = detector.score(pairs), detector.score(pairs, padded=True)
    assert distinct.probabilities == pytest.approx(padded.probabilities, abs=1e-4, nan_ok=True)
    assert np.nanstd(distinct.change) > 1e-4  # the tiles are told apart, so that equality says something


def test_samples_are_in_the_frame_of_their_tile(detector, pairs):
    samples = detector.describe(pairs.reference)["samples"]
    assert (np.abs(samples) <= np.array([0.75, 0.75, 0.5]) + 1e-4).all()


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
