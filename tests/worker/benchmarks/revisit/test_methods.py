"""Methods: from the store, from a checkpoint, and the baselines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from worker.benchmarks.revisit.baselines import baseline_methods
from worker.benchmarks.revisit.methods import DetectorScore, from_checkpoint, opened
from worker.detectors.card import MODEL_STORE
from worker.detectors.detector import Detection
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.store import open_card
from worker.errors import DetectorUnavailable

MODEL = "spicd-net/1"


def test_a_model_of_the_store_comes_with_the_threshold_of_its_card():
    method = opened(MODEL_STORE, MODEL)
    assert (method.name, method.stated) == (MODEL, open_card(MODEL_STORE, MODEL).threshold)


def test_a_checkpoint_scores_with_its_own_weights_and_states_no_threshold(tmp_path: Path, walked):
    path = tmp_path / "run" / "best.pt"
    path.parent.mkdir()
    torch.manual_seed(1)
    settings = {"pairs": {"patch_points": 1024}, "seed": 7}
    torch.save({"network": SpicdNetwork().state_dict(), "settings": settings}, path)
    method = from_checkpoint(path, MODEL_STORE, MODEL)
    assert (method.name, method.stated) == ("run/best.pt", None)
    pairs = walked["sparse"].pairs  # the one with the fewest tiles to score
    scores = method.score(pairs)
    assert np.isnan(scores).tolist() == (~pairs.observed).tolist()
    assert not np.allclose(scores, opened(MODEL_STORE, MODEL).score(pairs), equal_nan=True)


def test_what_a_detector_says_of_a_map_is_asked_once_and_anew_for_another_map(walked, made_visit):
    class Counting:
        described = 0

        def encode_reference(self, reference, tiles):
            self.described += 1
            return {"of": np.array([len(tiles.points)])}

        def detect(self, comparison, *, embedding):
            assert embedding["of"] == len(comparison.tiles)
            return Detection.of_scores(np.zeros(len(comparison.tiles)))

    score = DetectorScore(detector=Counting())
    for pairs in (walked["changed"].pairs, walked["sparse"].pairs, made_visit(cells=[[0, 0, 0]]).pairs):
        score(pairs)
    assert score.detector.described == 2


@pytest.mark.parametrize("content", [b"", b"nonsense"])
def test_what_is_no_checkpoint_is_named(tmp_path: Path, content: bytes):
    path = tmp_path / "last.pt"
    path.write_bytes(content)
    with pytest.raises(DetectorUnavailable, match=r"last\.pt is no checkpoint"):
        from_checkpoint(path, MODEL_STORE, MODEL)


def test_a_checkpoint_of_another_network_is_named(tmp_path: Path):
    settings = {"pairs": {"patch_points": 1024}, "seed": 7}
    torch.save({"network": {"weight": torch.zeros(1)}, "settings": settings}, tmp_path / "other.pt")
    with pytest.raises(DetectorUnavailable, match="no checkpoint of spicd-worker train"):
        from_checkpoint(tmp_path / "other.pt", MODEL_STORE, MODEL)


def test_a_missing_checkpoint_is_named(tmp_path: Path):
    with pytest.raises(DetectorUnavailable, match=r"no checkpoint at .*none\.pt"):
        from_checkpoint(tmp_path / "none.pt", MODEL_STORE, MODEL)


def test_every_baseline_scores_observed_tiles_and_no_others(walked):
    pairs = walked["changed"].pairs
    methods = baseline_methods()
    assert {"C2C (mean)", "M3C2-approx"} <= {method.name for method in methods}
    for method in methods:
        assert np.isnan(method.score(pairs)).tolist() == (~pairs.observed).tolist()
