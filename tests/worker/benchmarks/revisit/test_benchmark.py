"""The benchmark from end to end on visits that are there already; too few for figures worth citing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from tests.worker.benchmarks.revisit.conftest import SEED, TINY
from tests.worker.benchmarks.revisit.test_answers import by_voxels
from worker.benchmarks.methods import RevisitMethod
from worker.benchmarks.revisit import benchmark, gallery, part
from worker.benchmarks.revisit.plan import CASES, RevisitSettings, plan_visits
from worker.benchmarks.revisit.report import tables
from worker.benchmarks.revisit.tiles import tile_table
from worker.cli import main
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detection


def heights(comparison: Comparison) -> Detection:
    """A method that knows nothing of change."""
    return Detection.of_scores(np.where(comparison.observed, comparison.tiles[:, 2] / 10.0, np.nan))


@pytest.fixture(scope="module")
def out(visits_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The benchmark's folder, the visits already in it."""
    folder = tmp_path_factory.mktemp("out")
    (folder / part.VISITS).symlink_to(visits_folder)
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("TEST_SEED", "VALIDATION_SEED"):
            patch.setattr(benchmark, name, SEED)
        methods = (
            RevisitMethod(name="voxels", detect=by_voxels, tiles="touched", stated=0.5, sha256="0123"),
            RevisitMethod(name="heights", detect=heights),
        )
        patch.setattr(benchmark, "revisit_methods", lambda *_, **__: (methods, ["M3C2: not installed"]))
        patch.setattr(gallery, "DRAWN", 3)
        # the same few visits stand for the hard part
        patch.setattr(benchmark, "plan_hard_visits", lambda made: plan_visits(3, made, first_seed=SEED))
        settings = benchmark.RevisitBenchmarkSettings(
            out=out, visits=len(CASES), validation=len(CASES), made=TINY
        )
        return benchmark.evaluate(settings)


def test_methods_stand_in_one_document_and_nothing_is_made_twice(result: dict):
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert result["made"] == 0
    assert [row["name"] for row in result["methods"]] == ["voxels", "heights"]
    assert [row["sha256"] for row in result["methods"]] == ["0123", None]
    assert result["methods"][0]["stated"]["threshold"] == 0.5
    assert (result["test"]["visits"], result["test"]["without_change"]) == (8, 3)
    assert result["left_out"] == ["M3C2: not installed"]


def test_every_method_is_counted_by_the_same_changed_tiles(result: dict):
    assert result["test"]["changed"] > 0
    for row in result["methods"]:
        chosen = row["chosen"]
        assert chosen["true_positives"] + chosen["false_negatives"] == result["test"]["changed"]
        assert chosen["true_negatives"] + chosen["false_positives"] == result["test"]["unchanged"]
        assert chosen["f1"] <= row["best"]["f1"]


def test_only_a_method_by_voxels_tells_objects(result: dict):
    voxels, other = result["methods"]
    assert other["objects"] is None
    assert voxels["objects"]["regions"] == result["test"]["regions"] > 0
    assert voxels["objects"]["recall"] > 0.5
    assert voxels["objects"]["objects"] > 0
    assert len(voxels["objects"]["least_scores"]) == 1


def test_the_hard_part_is_counted_by_itself(result: dict):
    hard = result["methods"][0]["hard"]
    assert hard["quiet_visits"] == 1
    assert hard["chosen"]["threshold"] == result["methods"][0]["chosen"]["threshold"]


@pytest.mark.usefixtures("result")
def test_pictures_are_drawn_and_those_of_mistakes_are_listed(out: Path, result: dict):
    names = sorted(path.name for path in out.glob("*.png"))
    assert names == ["curves.png", "recall.png", "reliability.png"]
    listed = result["methods"][0]["errors"]
    assert "false object" in {row["what"] for row in listed}
    drawn = [out / "test" / row["picture"] for row in listed if row["picture"]]
    assert len(drawn) == 3 < len(listed)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in drawn)


def test_tables_name_every_method_and_what_was_left_out(result: dict):
    console = Console(width=200, record=True)
    console.print(tables(result))
    shown = console.export_text()
    for words in ("heights", "voxels", "the hard part", "M3C2: not installed", "moved, told as moved"):
        assert words in shown


def test_an_unknown_building_is_told_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["evaluate", "revisit", "--buildings", "attic", "--out", str(tmp_path)])
    assert end.value.code == 1
    assert "no building attic" in capsys.readouterr().err


def test_visits_without_a_changed_tile_are_told_in_a_sentence(made_visit, made_site):
    (plan,) = plan_visits(1, RevisitSettings(kinds=("room",)), first_seed=1)
    site = made_site(plan.site.name, tiles=1)
    table = tile_table([plan], [made_visit(plan.name, tiles=1)], {site.name: site}, min_points=1)
    with pytest.raises(ValueError, match="ask for more with --visits"):
        benchmark._check(table, "--visits")
