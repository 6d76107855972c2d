from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.detectors import CountingDetector
from worker.benchmarks.methods import open_model
from worker.benchmarks.speed import BenchSettings, bench, resized, scoring_bench, tables, ways
from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.detectors import registry
from worker.detectors.card import Card, Preprocessing
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.store import write_card, write_model


@pytest.fixture
def model_store(tmp_path: Path) -> Path:
    """Untrained weights: the bench asks how long, not how well."""
    needs = Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512)
    card = Card(
        name="spicd-net",
        version="1",
        detector="spicd-net",
        summary="untrained",
        threshold=0.5,
        preprocessing=needs,
        detector_settings={"patch_points": 4096, "seed": 42},
        weights="weights.safetensors",
    )
    write_model(tmp_path / "spicd-net" / "1", card, SpicdNetwork().state_dict())
    return tmp_path


def test_bench_times_every_stage_and_finds_the_same_scores_each_way(model_store: Path) -> None:
    figures = bench(BenchSettings(scans=4, tiles=6, repeats=1, model_store=model_store, model="spicd-net/1"))
    assert figures["network"]["tiles"] == 6
    assert figures["network"]["largest_score_difference"] < 1e-4
    assert list(figures["network"]["seconds"]) == ["c2c", "uncached", "cached"]
    assert figures["network"]["times_c2c"]["c2c"] == 1.0
    assert all(figures["map"][stage] > 0 for stage in ("fusing", "tiling", "encode", "total"))
    parts = [seconds for stage, seconds in figures["map"].items() if stage != "total"]
    assert sum(parts) == pytest.approx(figures["map"]["total"])
    survey = figures["survey_with_prior"]  # with so few scans it may well be refused
    stages = ("total",) if "rejected" in survey else ("score", "decide and export", "picture", "total")
    assert all(survey[stage] > 0 for stage in ("load map", *stages))
    assert figures["map_poses"]["of"] == 4
    assert figures["peak_memory_mb"] > 0
    assert tables(figures).renderables


def test_a_detector_by_voxels_is_timed_with_its_objects_beside_c2c_on_the_same_clouds() -> None:
    figures = bench(BenchSettings(scans=4, repeats=1, model="voxel-rule/1"))
    assert list(figures["network"]["seconds"]) == ["c2c", "voxels"]
    assert figures["network"]["times_c2c"]["voxels"] > 0
    assert figures["network"]["largest_score_difference"] is None
    survey = figures["survey_with_prior"]  # with so few scans it may well be refused
    assert "rejected" in survey or survey["objects"] > 0
    assert tables(figures).renderables


def test_any_detector_of_the_store_can_be_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "counting" / "1"
    folder.mkdir(parents=True)
    write_card(folder, CountingDetector.card)
    entry = registry.Entry(detector=f"{__name__}:CountingDetector")
    monkeypatch.setitem(registry.DETECTORS, "counting", entry)
    detector = open_model(tmp_path, "counting/1")
    pairs = made_pairs()
    figures = scoring_bench(pairs, ways(pairs, detector), repeats=2)
    assert list(figures["seconds"]) == ["c2c", "uncached", "cached"]
    assert isinstance(detector, CountingDetector)
    assert detector.encoded == 3  # once for the map, and with each of the two uncached scores
    assert detector.asked == [2] * 4


GRID = TileGrid(origin=np.array([70.0, 20.0, 0.0]), size=np.array([1.5, 1.5, 1.0]), shape=(3, 1, 1))
INDICES = np.array([[i, 0, 0] for i in range(3)], np.int32)


def made_pairs() -> TilePairs:
    """Three tiles whose clouds are told apart by their sizes; the second was not observed."""

    def clouds(*counts: int) -> tuple[np.ndarray, ...]:
        return tuple(np.zeros((count, 3), np.float32) for count in counts)

    return TilePairs(
        reference=Tiles(grid=GRID, indices=INDICES, points=clouds(100, 200, 500)),
        current=clouds(300, 0, 90),
        observed=np.array([True, False, True]),
    )


def test_pairs_are_taken_again_until_there_are_as_many_as_asked_for():
    more = resized(made_pairs(), 5)
    assert [len(points) for points in more.current] == [300, 90, 300, 90, 300]
    assert more.reference.indices[:, 0].tolist() == [0, 2, 0, 2, 0]
    assert more.observed.all()
