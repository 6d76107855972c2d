"""The benchmark from end to end on visits that are there already; too few for figures worth citing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from worker.benchmarks.methods import Method
from worker.benchmarks.revisit import benchmark
from worker.benchmarks.revisit.measures import tile_table
from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.report import tables, verdicts_of
from worker.cli import main
from worker.cloud.tiling import TilePairs

TINY = RevisitSettings(kinds=("room",), stops={"room": 3}, edits={"room": 3}, standing_s=2.0)


def heights(pairs: TilePairs) -> np.ndarray:
    """A method that knows nothing of change."""
    return np.where(pairs.observed, pairs.reference.indices[:, 2].astype(float), np.nan)


@pytest.fixture(scope="module")
def out(visits_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The benchmark's folder, the visits already in it."""
    folder = tmp_path_factory.mktemp("out")
    (folder / benchmark.VISITS).symlink_to(visits_folder)
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("TEST_SEED", "VALIDATION_SEED"):
            patch.setattr(benchmark, name, 51)
        method = Method(name="heights", score=heights, stated=0.5, sha256="0123")
        patch.setattr(benchmark, "detector_methods", lambda *_: (method,))
        settings = benchmark.RevisitBenchmarkSettings(out=out, visits=3, validation=3, made=TINY)
        return benchmark.evaluate(settings)


def test_methods_stand_in_one_document_and_nothing_is_made_twice(result: dict):
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert result["made"] == 0
    assert [row["name"] for row in result["methods"]][:2] == ["heights", "C2C (mean)"]
    assert result["methods"][0]["stated"]["threshold"] == 0.5
    assert [row["sha256"] for row in result["methods"]][:2] == ["0123", None]
    assert (result["test"]["visits"], result["test"]["without_change"]) == (3, 1)


def test_every_changed_tile_is_counted_or_told_as_not_looked_at(result: dict):
    changed = result["test"]["changed"]
    assert sum(changed.values()) == sum(visit["changed"] for visit in result["test"]["by_visit"])
    for row in result["methods"]:
        found = row["chosen"]["true_positives"] + row["chosen"]["false_negatives"]
        assert found == changed["counted"]
        assert row["chosen"]["unobserved_changed"] == changed["unobserved"] + changed["out_of_sight"]


def test_every_method_gets_a_threshold_that_is_no_better_than_the_best_one(result: dict):
    for row in result["methods"]:
        assert row["chosen"]["f1"] <= row["best"]["f1"]


@pytest.mark.usefixtures("result")
def test_pictures_are_drawn(out: Path):
    names = sorted(path.name for path in out.glob("*.png"))
    assert names[:2] == ["curves.png", "recall.png"]
    assert names[2].startswith("tiles-room-51-")
    assert all((out / name).read_bytes().startswith(b"\x89PNG") for name in names)


def test_tables_name_every_method_and_what_nobody_looked_at(result: dict):
    console = Console(width=160, record=True)
    console.print(tables(result))
    shown = console.export_text()
    assert "heights" in shown
    assert "M3C2-approx" in shown
    assert "not observed by the survey" in shown
    assert "0.5 to 1 cm" in shown


def test_a_verdict_for_every_tile(made_visit):
    visit = made_visit(
        cells=[[50, 0, 0], [50, 0, 0], [0, 0, 0], [0, 0, 0], [50, 0, 0], [0, 0, 0]],
        observed=[True, True, True, True, False, False],
    )
    scores = np.array([0.9, 0.1, 0.9, 0.1, np.nan, np.nan])
    assert verdicts_of(visit, scores, 0.5) == [
        "hit",
        "missed",
        "false alarm",
        "rightly quiet",
        "changed, nobody looked",
        "not observed",
    ]


def test_an_unknown_building_is_told_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["evaluate", "revisit", "--buildings", "attic", "--out", str(tmp_path)])
    assert end.value.code == 1
    assert "no building attic" in capsys.readouterr().err


def test_visits_without_a_changed_tile_are_told_in_a_sentence(made_visit):
    table = tile_table(plan_visits(1, TINY, first_seed=1), [made_visit(cells=[[0, 0, 0]])])
    with pytest.raises(ValueError, match="ask for more with --visits"):
        benchmark._check(table, "--visits")
