"""The benchmark from its settings to its tables and pictures, on one room."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from tests.support.placement import SETTINGS
from worker.benchmarks.placement import real
from worker.benchmarks.placement.benchmark import PlacementBenchmarkSettings, evaluate
from worker.benchmarks.placement.real import real_places, real_trials
from worker.benchmarks.placement.report import tables
from worker.cloud.poses import difference


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    settings = PlacementBenchmarkSettings(
        out=tmp_path_factory.mktemp("out"),
        part="calibration",
        only=("right", "scaled"),
        trials=1,
        processes=1,
        made=SETTINGS,
    )
    return settings, evaluate(settings)


def test_a_small_run_gives_a_row_a_trial_and_right_poses_without_changes(result):
    _, told = result
    rows = {row["name"]: row for row in told["rows"]}
    assert len(rows) == 8 + 5
    assert rows["right 0% changed, prior"]["right"] == 1
    json.dumps(told, allow_nan=False)


def test_the_tables_and_pictures_show_it(result):
    settings, told = result
    console = Console(width=200, record=True)
    console.print(tables(told))
    text = console.export_text()
    assert "right 25% changed, prior" in text and "scaled by 1.05" in text
    assert (settings.out / "errors.png").read_bytes().startswith(b"\x89PNG")


def test_a_second_run_scores_what_is_kept(result, monkeypatch):
    settings, told = result
    monkeypatch.setattr("worker.benchmarks.placement.answers.locate_survey", None)
    assert evaluate(settings)["rows"] == told["rows"]


def test_real_scans_are_sent_to_every_map_and_spoilt_ones_have_no_place(shared_data: Path, tmp_path: Path):
    trials = real_trials(shared_data, SETTINGS.pipeline, tmp_path)
    strangers = [trial for trial in trials if " of " in trial.name and trial.true is None]
    assert len(strangers) == 52
    names = [trial.name for trial in trials]
    assert len(set(names)) == len(names)
    turned = [trial for trial in trials if "turned by 90" in trial.name]
    assert len(turned) == 5
    for trial in turned:
        assert trial.prior is not None and trial.true is not None
        assert difference(trial.true, trial.prior) == pytest.approx((0, np.pi / 2), abs=1e-6)
    assert sum("shifted by 5 km" in name for name in names) == 1
    assert len(real_places(shared_data, SETTINGS.pipeline)[-1].others) == 4
    assert all(trial.path.exists() and trial.site.exists() for trial in trials)
    assert real.SHIFTED in names[0]
