"""The command from end to end on one small room: quick, and too small for figures worth citing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from worker.benchmarks.registration import real
from worker.benchmarks.registration.benchmark import RegistrationBenchmarkSettings, evaluate
from worker.cli import main

WORDS = [
    "evaluate",
    "registration",
    "--building",
    "room",
    "--scans",
    "4",
    "--foreign",
    "1",
    "--standing",
    "2",
]


def run(*words: str) -> int:
    try:
        main([*WORDS, *words])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_a_small_walk_is_built_measured_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--seeds", "3", "--scenarios", "drifted", "--plain-pairs", "2"]
    assert run(*words, "--json", "--out", str(tmp_path / "out")) == 0
    told = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "out" / "registration.json").read_text()) == told
    (row,) = told["scenarios"]
    assert (row["scenario"], row["seed"], row["of"], row["foreign"]) == ("drifted", 3, 4, 0)
    assert (row["accepted"], row["wrong"]) == (4, 0)
    assert row["centimetres"]["worst"] < 3
    assert row["degrees"]["worst"] < 0.5
    stages = [seconds for stage, seconds in row["seconds"].items() if stage != "total"]
    assert row["seconds"]["total"] == pytest.approx(sum(stages))
    for what in ("map", "errors"):
        assert (tmp_path / "out" / f"{what}-drifted-3.png").read_bytes().startswith(b"\x89PNG")
    assert [way["gates"][0] for way in told["plain"]] == [0.6, 0.05]
    assert all(way["pairs_possible"] == 6 for way in told["plain"])
    assert told["survey"]["centimetres"] < 3


def test_tables_are_shown_where_json_is_not_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--seeds", "3", "--scenarios", "drifted", "--no-survey") == 0
    shown = capsys.readouterr().out
    assert "4 of 4" in shown
    assert "25 of 42" in shown
    assert "warm map" not in shown


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--scenarios", "upright"], "no scenario upright"),
        (["--seeds", "1;2"], "whole numbers with commas"),
        (["--scenarios", "lost", "--plain"], "`drifted`"),
    ],
)
def test_what_cannot_be_run_is_told_in_a_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*words) == 1
    assert sentence in capsys.readouterr().err


def test_real_scans_are_joined_as_the_given_transforms_have_it_and_out_of_place_scans_are_not(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some of them; the command's `--real` runs them all."""
    monkeypatch.setattr(real, "PAIRS", real.PAIRS[:2])
    monkeypatch.setattr(real, "FRAMES", real.FRAMES[:3])
    monkeypatch.setattr(real, "OUT_OF_PLACE", real.OUT_OF_PLACE[:1])
    found = evaluate(RegistrationBenchmarkSettings(kinds=(), survey=False, real=shared_data))["real"]
    assert [row["name"] for row in found["pairs"]] == ["room_scan", "corridor_pair"]
    assert all(row["joined"] for row in found["pairs"])
    assert all(row["centimetres"] < 3 and row["degrees"] < 0.5 for row in found["pairs"])
    assert (found["frames"]["accepted"], found["frames"]["pairs_compared"]) == (3, 2)
    assert found["frames"]["centimetres_worst"] < 3
    assert [row["joined"] for row in found["foreign"]] == [False]
