"""The benchmark on the smallest real pair, the page it writes, and what the product must never say of real scans."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from worker.benchmarks.real.answers import answer_of
from worker.benchmarks.real.benchmark import RealBenchmarkSettings, evaluate
from worker.benchmarks.real.report import tables, write_report
from worker.benchmarks.real.visits import PLANS, given_poses, visits_by
from worker.cli import terminal
from worker.detectors.card import MODEL_STORE
from worker.detectors.store import open_detector


@pytest.mark.slow
def test_the_smallest_pair_runs_from_files_to_a_page(shared_data: Path, tmp_path: Path) -> None:
    settings = RealBenchmarkSettings(
        folder=shared_data,
        models=("voxel-rule/1", "c2c/1"),
        places=("corridor_pair",),
        seeds=1,
        registered=False,
        out=tmp_path,
    )
    result = evaluate(settings)
    assert [pair["name"] for pair in result["pairs"]] == [
        "corridor_pair, first to second",
        "corridor_pair, second to first",
    ]
    assert [one["objects"] is None for one in result["pairs"][0]["answers"]] == [False, True]
    assert len(result["edited"]["pairs"]) == 4
    page = write_report(result, tmp_path).read_text()
    assert json.loads((tmp_path / "real.json").read_text()) == result
    assert "![corridor_pair, first to second](corridor-pair-first-to-second.png)" in page
    terminal.output().print(tables(result))
    of_tiles = [model for model in result["edited"]["models"] if model["found"] is None]
    edited = {
        **result["edited"],
        "models": of_tiles,
    }  # who scores tiles tells no things, and so no table of them
    assert "| things |" in write_report(result, tmp_path).read_text().replace(" voxel-rule/1 |", "")
    assert "| things |" not in write_report({**result, "edited": edited}, tmp_path).read_text()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["voxel-net/1", "voxel-rule/1"])
def test_a_map_of_two_real_scans_says_nothing_of_those_very_scans(shared_data: Path, model: str) -> None:
    poses = given_poses(shared_data, ("room_scan",))
    detector = open_detector(MODEL_STORE, model)
    for plan in PLANS:
        if plan.name.startswith("room_scan, 1 and 2"):
            visits = visits_by(shared_data, plan, poses)
            assert visits.same
            told = answer_of(detector, visits)
            assert told.objects == ()
            assert told.counts()["changed"] == 0


def test_each_place_is_looked_at_both_ways() -> None:
    ways = {(plan.first, plan.second) for plan in PLANS if len(plan.first) == 1 and plan.place != "kinect"}
    assert ways == {(second, first) for first, second in ways}
    assert len({plan.name for plan in PLANS}) == len(PLANS)


def test_an_unknown_place_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no place attic"):
        evaluate(RealBenchmarkSettings(folder=tmp_path, models=(), places=("attic",)))
    assert given_poses(tmp_path, ()) == {}
