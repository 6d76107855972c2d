"""The command from end to end on a short corridor: quick, and too small for figures worth citing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from worker.benchmarks.baselines import m3c2_is_installed
from worker.cli import main
from worker.detectors.card import MODEL_STORE
from worker.detectors.store import open_card


def run(*words: str) -> int:
    try:
        main(["evaluate", "paper", *words])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_three_experiments_are_run_told_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--quick", "--true-poses", "--json", "--out", str(tmp_path)) == 0
    told = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "paper.json").read_text()) == told
    assert told["command"] == "spicd-worker evaluate paper --true-poses --quick"
    assert told["sha256"] == open_card(MODEL_STORE, "spicd-net/2").sha256
    names = [row["name"] for row in told["table_5"]]
    assert names == ["magnitude_15cm", "type_remove", "baseline_no_change", "aggregated"]
    tiles = told["map"]["tiles"]
    for row in told["table_5"][:-1]:
        assert sum(row[name] for name in COUNTS) == tiles
        assert row["true_positives"] + row["false_negatives"] <= row["scans"] * row["tiles_per_scan"]
    methods = {row["method"]: row for row in told["table_6"]}
    expected = {"spicd-net/2", "C2C (mean)", "C2C (share over 10 cm)", "M3C2-approx"}
    assert set(methods) == expected | ({"M3C2"} if m3c2_is_installed() else set())
    assert told["left_out"] == ([] if m3c2_is_installed() else ["M3C2"])
    for row in methods.values():
        assert row["at_test_threshold"]["f1"] >= (row["f1"] or 0)
    # at true poses untouched tiles are equal to the last bit, so that any distance is a change
    assert methods["C2C (mean)"]["at_test_threshold"]["f1"] == 1.0
    assert told["robustness"][0]["level"] == 0
    assert told["robustness_experiments"] == ["type_remove"]  # of those that were run
    undisturbed, row = told["robustness"][0], told["table_5"][1]
    assert {name: undisturbed[name] for name in COUNTS} == {name: row[name] for name in COUNTS}
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(list(tmp_path.glob("*.png"))) >= 9
    assert "magnitude_15cm" in page


COUNTS = ("true_positives", "false_positives", "false_negatives", "true_negatives")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--model", "nobody/7"], "no model at"),
        (["--weights", "nowhere.pt"], "no checkpoint at nowhere.pt"),
    ],
)
def test_what_cannot_be_measured_is_told_in_a_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--quick", *words) == 1
    assert sentence in capsys.readouterr().err


def test_several_models_share_the_corridors_and_have_a_folder_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--quick", "--true-poses", "--no-robustness", "--model", "spicd-net/1", "--model", "c2c/1"]
    assert run(*words, "--out", str(tmp_path)) == 0
    told = [json.loads((tmp_path / name / "paper.json").read_text()) for name in ("spicd-net-1", "c2c-1")]
    assert [one["model"] for one in told] == ["spicd-net/1", "c2c/1"]
    cards = [open_card(MODEL_STORE, one["model"]) for one in told]
    assert [one["fingerprint"] for one in told] == [card.fingerprint for card in cards]
    first, second = ({row["method"]: row for row in one["table_6"]} for one in told)
    assert first["M3C2-approx"] == second["M3C2-approx"]
    changed = [row for row in told[1]["table_5"] if row.get("operation") == "remove"]
    assert second["c2c/1"]["removals"] == {
        name: value for name, value in changed[0].items() if name in second["c2c/1"]["removals"]
    }
    assert "c2c/1" in capsys.readouterr().out
    assert run(*words, "--json") == 1
