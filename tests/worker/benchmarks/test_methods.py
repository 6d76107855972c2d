"""Methods: from the store, from a checkpoint, and the baselines; a map is encoded once, a tile scored once."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.detectors import CountingDetector
from tests.support.visits import compared, seen_by
from worker.benchmarks.methods import (
    CachedDetector,
    ablations,
    baseline_methods,
    open_model,
    revisit_methods,
    stored_models,
    training_log,
)
from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.detectors.card import MODEL_STORE
from worker.detectors.comparison import Comparison
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.store import WEIGHTS, open_card, open_detector, read_card, write_card, write_model
from worker.errors import DetectorUnavailable
from worker.pipeline.settings import PipelineSettings
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit
from worker.training.log import LOG

MODEL = "spicd-net/1"
PIPELINE = PipelineSettings()
SOUND = {"seed": 7, "pairs": {"patch_points": 1024}}


@pytest.fixture
def pairs() -> TilePairs:
    """Three tiles of 600 points, the second of which was not observed."""
    rng = np.random.default_rng(3)
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(3, 1, 1))
    indices = np.array([[i, 0, 0] for i in range(3)], np.int32)

    def clouds() -> tuple[np.ndarray, ...]:
        corners = grid.lower(indices)
        return tuple((corner + rng.random((600, 3)) * grid.size).astype(np.float32) for corner in corners)

    return TilePairs(
        reference=Tiles(grid=grid, indices=indices, points=clouds()),
        current=clouds(),
        observed=np.array([True, False, True]),
    )


def test_a_model_of_the_store_comes_with_the_threshold_and_the_weights_of_its_card() -> None:
    (method,), left_out = revisit_methods(MODEL_STORE, MODEL, (), PIPELINE, others=False)
    card = open_card(MODEL_STORE, MODEL)
    assert (method.name, method.stated, method.sha256) == (MODEL, card.threshold, card.sha256)
    assert (method.tiles, method.min_points) == ("dense", 512)
    assert left_out == []


def test_a_checkpoint_scores_with_its_own_weights_and_states_no_threshold(
    tmp_path: Path, pairs: TilePairs
) -> None:
    path = tmp_path / "run" / "best.pt"
    path.parent.mkdir()
    torch.manual_seed(1)
    torch.save({"network": SpicdNetwork().state_dict(), "settings": SOUND}, path)
    (method,), _ = revisit_methods(MODEL_STORE, MODEL, (path,), PIPELINE, others=False)
    assert (method.name, method.stated) == ("run/best.pt", None)
    scores = method.detect(Comparison.of_tiles(pairs)).change
    assert np.isnan(scores).tolist() == (~pairs.observed).tolist()
    (shipped,), _ = revisit_methods(MODEL_STORE, MODEL, (), PIPELINE, others=False)
    assert not np.allclose(scores, shipped.detect(Comparison.of_tiles(pairs)).change, equal_nan=True)


def test_all_models_of_the_store_come_after_the_one_that_is_asked_for_then_the_baselines() -> None:
    methods, left_out = revisit_methods(MODEL_STORE, MODEL, (), PIPELINE)
    names = [method.name for method in methods]
    stored = stored_models(MODEL_STORE)
    assert {"c2c/1", "spicd-net/1", "voxel-rule/1"} <= set(stored)
    assert names[0] == MODEL
    assert set(names[1 : len(stored)]) == set(stored) - {MODEL}
    assert names[len(stored)] == "C2C (mean)"
    assert {method.name for method in methods if method.tells_voxels} >= {"voxel-rule/1"}
    installed = any(name == "M3C2" for name in names)
    assert left_out == ([] if installed else ["M3C2: py4dgeo is not installed"])


def test_a_model_that_needs_other_voxels_is_left_out_and_refused_where_it_is_asked_for(
    tmp_path: Path,
) -> None:
    card = open_card(MODEL_STORE, "c2c/1")
    coarse = card.preprocessing.model_copy(update={"voxel_size": 0.1})
    for name, needs in (("c2c", card.preprocessing), ("coarse", coarse)):
        (tmp_path / name / "1").mkdir(parents=True)
        write_card(
            tmp_path / name / "1",
            card.model_copy(update={"name": name, "version": "1", "preprocessing": needs}),
        )
    methods, left_out = revisit_methods(tmp_path, "c2c/1", (), PIPELINE)
    assert "coarse/1" not in [method.name for method in methods]
    assert "coarse/1 needs voxels of 0.1 m" in left_out[0]
    with pytest.raises(DetectorUnavailable, match="coarse/1 needs voxels"):
        revisit_methods(tmp_path, "coarse/1", (), PIPELINE)


def test_a_checkpoint_brings_its_weights_patch_size_and_seed(tmp_path: Path) -> None:
    torch.save({"settings": SOUND, "network": SpicdNetwork().state_dict()}, tmp_path / "fresh.pt")
    card = open_model(MODEL_STORE, MODEL, tmp_path / "fresh.pt").card
    shipped = open_card(MODEL_STORE, MODEL)
    assert (card.detector_settings["patch_points"], card.detector_settings["seed"]) == (1024, 7)
    assert (card.name, card.version) == ("spicd-net", "fresh")
    assert card.preprocessing.tile_size == shipped.preprocessing.tile_size
    assert card.threshold == shipped.threshold
    assert card.sha256 != shipped.sha256


def test_a_checkpoint_has_the_sha256_of_the_model_that_is_made_of_it(tmp_path: Path) -> None:
    weights = SpicdNetwork().state_dict()
    torch.save({"settings": SOUND, "network": weights}, tmp_path / "fresh.pt")
    measured = open_model(MODEL_STORE, MODEL, tmp_path / "fresh.pt").card
    made = write_model(tmp_path / "model", measured, weights)
    assert measured.sha256 == hashlib.sha256((made / WEIGHTS).read_bytes()).hexdigest()
    assert read_card(made) == measured


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no archive at all",
        {"network": {}},
        {"network": {"layer": 1}, "settings": SOUND},
        {"network": {"weight": torch.zeros(1)}, "settings": SOUND},  # of another network
    ],
)
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes | dict[str, Any]) -> None:
    path = tmp_path / "odd.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(DetectorUnavailable, match=r"odd\.pt is no checkpoint of spicd-worker train"):
        open_model(MODEL_STORE, MODEL, path)


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(DetectorUnavailable, match=r"no checkpoint at .*none\.pt"):
        open_model(MODEL_STORE, MODEL, tmp_path / "none.pt")


def test_the_log_is_that_beside_the_model_or_beside_the_checkpoint(tmp_path: Path) -> None:
    model, run = tmp_path / "spicd-net" / "7", tmp_path / "run"
    for folder, loss in ((model, 0.5), (run, 0.25)):
        folder.mkdir(parents=True)
        (folder / LOG).write_text(f"epoch,train_loss\n1,{loss}\n")
    assert training_log(tmp_path, "spicd-net/7", None) == [{"epoch": 1, "train_loss": 0.5}]
    assert training_log(tmp_path, "spicd-net/7", run / "best.pt") == [{"epoch": 1, "train_loss": 0.25}]


@pytest.mark.parametrize("text", [None, "epoch,train_loss\n"])
def test_without_a_log_or_an_epoch_in_it_there_is_none(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / LOG).write_text(text)
    assert training_log(tmp_path, "spicd-net/7", tmp_path / "best.pt") is None


def test_a_map_is_encoded_once_and_another_map_anew(pairs: TilePairs) -> None:
    same = Tiles(
        grid=pairs.reference.grid,
        indices=pairs.reference.indices.copy(),
        points=tuple(points.copy() for points in pairs.reference.points),
    )
    moved = replace(same, points=tuple(points + np.float32(0.01) for points in same.points))
    detector = CountingDetector()
    cached = CachedDetector(detector=detector)
    for reference in (pairs.reference, same, moved):
        assert np.isnan(cached.score(replace(pairs, reference=reference))).tolist() == [False, True, False]
    assert detector.encoded == 2
    assert detector.asked == [2, 2]  # the second time every tile was known


def test_every_baseline_scores_observed_tiles_and_no_others(pairs: TilePairs) -> None:
    methods = baseline_methods()
    assert {"C2C (mean)", "M3C2-approx"} <= {method.name for method in methods}
    for method in methods:
        assert np.isnan(method.score(pairs)).tolist() == (~pairs.observed).tolist()


def test_ablations_take_the_gate_and_the_free_space_away() -> None:
    scans = visit(random_room(11), 4, seed=3)
    comparison = compared(seen_by(scans), seen_by(scans[:1]))
    whole = open_detector(MODEL_STORE, "voxel-net/1").detect(comparison)
    blind, ungated = (
        method.detect(comparison) for method in ablations(MODEL_STORE, "voxel-net/1", PipelineSettings())
    )
    assert whole.voxels is not None
    assert blind.voxels is not None
    assert ungated.voxels is not None
    unjudged = ~whole.voxels.judged
    assert whole.voxels.disappeared[unjudged].max() == 0
    assert ungated.voxels.disappeared[unjudged].max() > 0
    assert blind.voxels.judged.sum() > whole.voxels.judged.sum()  # nobody knows where nobody looked


def test_only_models_by_voxels_have_something_to_take_away() -> None:
    with pytest.raises(ValueError, match="no gate"):
        ablations(MODEL_STORE, "c2c/1", PipelineSettings())
