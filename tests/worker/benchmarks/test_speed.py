from __future__ import annotations

import json
from pathlib import Path

import pytest

from worker.benchmarks.speed import BenchSettings, bench, save
from worker.cli.bench import _tables
from worker.detectors.card import Card, Preprocessing
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.detectors.store import write_model


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


def test_bench_times_every_stage_and_finds_the_same_scores_each_way(
    model_store: Path, tmp_path: Path
) -> None:
    figures = bench(BenchSettings(scans=4, tiles=6, repeats=1, model_store=model_store))
    assert figures["network"]["tiles"] == 6
    assert figures["network"]["largest_score_difference"] < 1e-4
    assert list(figures["network"]["seconds"]) == ["uncached", "cached"]
    assert figures["network"]["times_faster_than_uncached"]["uncached"] == 1.0
    stages = ("read and register", "normals", "tile", "encode", "total")
    assert all(figures["map"][stage] > 0 for stage in stages)
    assert figures["map_poses"]["of"] == 4
    assert figures["peak_memory_mb"] > 0
    save(figures, tmp_path / "bench" / "figures.json")
    assert json.loads((tmp_path / "bench" / "figures.json").read_text()) == figures
    assert _tables(figures).renderables
