"""SPICD-Net as a detector: with the map's embedding or without, by distinct or padded points, the scores are the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worker.cloud.patches import patch
from worker.cloud.tiling import TilePairs
from worker.cloud.types import Arrays
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison
from worker.detectors.siamese.chamfer import chamfer_statistics
from worker.detectors.spicd_net.detector import SpicdNet
from worker.errors import Cancelled
from worker.progress import Progress, no_progress


def compared(pairs: TilePairs) -> Comparison:
    return Comparison.of_tiles(pairs)


def encoded(detector: SpicdNet, pairs: TilePairs, progress: Progress = no_progress) -> Arrays:
    return detector.encode_reference(compared(pairs).reference, pairs.reference, progress=progress)


def with_settings(card: Card, **settings) -> Card:
    return card.model_copy(update={"detector_settings": {**card.detector_settings, **settings}})


@pytest.fixture
def detector(card, network) -> SpicdNet:
    return SpicdNet(card, network, torch.device("cpu"))


def test_scores_are_probabilities_where_observed_and_nan_elsewhere(detector, pairs):
    scores = detector.detect(compared(pairs))
    assert scores.probabilities.shape == (5, 3)
    assert scores.probabilities.dtype == np.float32
    assert np.isnan(scores.probabilities).all(axis=1).tolist() == [False, False, True, False, False]
    assert scores.probabilities[pairs.observed].sum(axis=1) == pytest.approx(1, abs=1e-5)


def test_a_kept_embedding_gives_the_same_scores(detector, pairs):
    embedding = encoded(detector, pairs)
    assert {name: array.shape for name, array in embedding.items()} == {"descriptors": (5, 1024)}
    kept, fresh = detector.detect(compared(pairs), embedding=embedding), detector.detect(compared(pairs))
    assert np.array_equal(kept.probabilities, fresh.probabilities, equal_nan=True)


def test_distinct_points_give_the_descriptor_of_the_padded_patch(detector, network, pairs):
    descriptors = encoded(detector, pairs)["descriptors"]
    centres = pairs.reference.grid.centers(pairs.reference.indices)
    for points, centre, descriptor in zip(pairs.reference.points, centres, descriptors, strict=True):
        cut = patch((points - centre).astype(np.float32), size=1024, seed=42)
        padded = torch.from_numpy(cut.padded() - cut.centroid)
        with torch.inference_mode():
            expected = network.encoder(padded, [len(padded)])[0][0].numpy()
        assert descriptor == pytest.approx(expected, abs=1e-4)
    assert (
        np.std(descriptors, axis=0).max() > 1e-3
    )  # the tiles are told apart, so that equality says something


@pytest.mark.parametrize("chamfer_points", [None, 128])
def test_a_survey_that_finds_the_same_points_differs_by_nothing_but_the_sample(
    card, network, pairs, chamfer_points, monkeypatch
):
    """All points of equal tiles are at distance 0; two samples of them are not, and the scores say so."""
    detector = SpicdNet(with_settings(card, chamfer_points=chamfer_points), network, torch.device("cpu"))
    same = type(pairs)(reference=pairs.reference, current=pairs.reference.points, observed=pairs.observed)
    seen = []

    def noted(*clouds, **options):
        seen.append(chamfer_statistics(*clouds, **options))
        return seen[0]

    monkeypatch.setattr(
        "worker.detectors.siamese.detector.chamfer_statistics",
        noted,
    )
    detector.detect(compared(same))
    (statistics,) = seen
    assert (statistics == 0).all() == (chamfer_points is None)
    assert statistics.max() < 0.5


def test_a_sample_larger_than_the_patch_is_refused(card, network):
    with pytest.raises(ValueError, match="Chamfer sample takes 1025 of a patch's 1024 points"):
        SpicdNet(with_settings(card, chamfer_points=1025), network, torch.device("cpu"))


def test_an_embedding_of_another_map_is_refused(detector, pairs):
    embedding = {name: array[:4] for name, array in encoded(detector, pairs).items()}
    with pytest.raises(ValueError, match="another map or model"):
        detector.detect(compared(pairs), embedding=embedding)


def test_progress_rises_to_one_and_may_cancel(detector, pairs):
    reports: list[tuple[str, float]] = []
    detector.detect(compared(pairs), progress=lambda stage, share: reports.append((stage, share)))
    shares = [share for stage, share in reports if stage == "scoring"]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0

    def dismissed(stage: str, share: float) -> None:
        raise Cancelled("dismissed")

    with pytest.raises(Cancelled):
        encoded(detector, pairs, progress=dismissed)


def test_no_observed_tile_is_no_error(detector, pairs):
    nothing = type(pairs)(reference=pairs.reference, current=pairs.current, observed=np.zeros(5, dtype=bool))
    assert np.isnan(detector.detect(compared(nothing)).probabilities).all()
