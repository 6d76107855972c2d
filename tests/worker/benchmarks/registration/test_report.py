"""The tables say what the figures say."""

from __future__ import annotations

import re
from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from worker.benchmarks.registration.report import tables

PAPER = {
    "scans": 42,
    "accepted": 25,
    "mean_rmse": 0.025,
    "std_rmse": 0.0045,
    "mean_fitness": 0.592,
    "std_fitness": 0.089,
    "calls_saved": 0.8,
}
SCENARIO: dict[str, Any] = {
    "scenario": "lost+foreign",
    "seed": 7,
    "accepted": 40,
    "of": 42,
    "foreign_accepted": 1,
    "foreign": 5,
    "wrong": 2,
    "centimetres": {"median": 1.23, "worst": 45.6},
    "degrees": {"median": 0.078, "worst": 0.91},
    "translation_sigma": {"within_2_sigma": 0.93, "median_error_over_sigma": 0.71},
    "rotation_sigma": None,
    "missing": ["scan-08", "scan-30"],
    "report": {
        "mean_rmse": 0.0261,
        "std_rmse": 0.0012,
        "mean_fitness": 0.701,
        "std_fitness": 0.055,
        "calls_saved": 0.85,
        "pairs_tried": 162,
        "pairs_possible": 1081,
        "pairs_accepted": 120,
        "pairs_contradicted": 3,
    },
    "seconds": {"reading": 1.0, "pairs": 30.25, "total": 31.25},
    "processor_seconds": 52.5,
}
PLAIN: dict[str, Any] = {
    "gates": [0.6, 0.05],
    "pairs_run": 300,
    "pairs_possible": 861,
    "accepted": 39,
    "pairs_accepted": 90,
    "pairs_wrong": 21,
    "our_pairs": 110,
    "our_pairs_wrong": 0,
    "common": {"pairs": 0},
    "common_right": {
        "pairs": 61,
        "centimetres": {"median": 0.41, "95%": 1.92},
        "degrees": {"median": 0.02, "95%": 0.11},
    },
    "to_the_truth": {
        "wrong": 5,
        "centimetres": {"median": 3.8, "worst": 1718.6},
        "degrees": {"median": 0.3, "worst": 91.0},
    },
    "seconds": {"pairs": 400.0, "total": 412.0},
    "processor_seconds": 500.0,
    "times_faster": 13.2,
}
REAL: dict[str, Any] = {
    "pairs": [
        {
            "name": "room_scan",
            "joined": True,
            "centimetres": 1.4,
            "degrees": 0.21,
            "fitness": 0.5,
            "rmse_centimetres": 2.9,
            "seconds": 2.5,
        },
        {"name": "corridor_pair", "joined": False, "seconds": 3.5},
    ],
    "frames": {
        "name": "kinect_pairwise",
        "frames": 5,
        "accepted": 4,
        "pairs_compared": 3,
        "centimetres_worst": 0.8,
        "degrees_worst": 0.3,
        "seconds": 9.0,
    },
    "foreign": [{"names": ["a.pcd", "b.ply"], "joined": True, "seconds": 1.0}],
}


def shown(result: dict[str, Any]) -> str:
    console = Console(width=200, record=True, file=StringIO())
    console.print(tables(result), highlight=False)
    return console.export_text()


def row(text: str, head: str) -> str:
    """What stands in the row that begins with `head`."""
    (found,) = [line for line in text.splitlines() if re.match(rf"^[│┃ ]*{re.escape(head)} ", line)]
    return found


@pytest.fixture
def scenario_alone() -> dict[str, Any]:
    return {"paper": PAPER, "scenarios": [SCENARIO]}


def test_a_scenario_stands_beside_the_paper(scenario_alone: dict[str, Any]) -> None:
    text = shown(scenario_alone)
    assert "lost+foreign, seed 7" in text
    for head, *said in (
        ("scans placed", "40 of 42", "25 of 42"),
        ("scans of another building placed", "1 of 5"),
        ("off the truth, median (worst)", "1.2 (45.6) cm", "0.08 (0.91) degrees"),
        ("placed, but over 10 cm off", "2"),
        ("within 2 sigma; median error / sigma", "shift 93%; 0.71"),
        ("RMSE of accepted pairs", "2.61 ± 0.12 cm", "2.50 ± 0.45 cm"),
        ("fitness of accepted pairs", "0.701 ± 0.055", "0.592 ± 0.089"),
        ("ICP calls saved", "85% (162 of 1081 tried)", "over 80%"),
        ("seconds", "31.2 (52.5 of processors)"),
    ):
        assert all(words in row(text, head) for words in said)
    assert "pairs 30.2" in text
    assert "scan-08, scan-30" in text


def test_a_scenario_of_which_nothing_was_placed_can_be_shown(scenario_alone: dict[str, Any]) -> None:
    empty = {"accepted": 0, "centimetres": None, "degrees": None, "translation_sigma": None}
    empty["report"] = SCENARIO["report"] | dict.fromkeys(
        ("mean_rmse", "std_rmse", "mean_fitness", "std_fitness")
    )
    text = shown(scenario_alone | {"scenarios": [SCENARIO | empty]})
    assert "0 of 42" in row(text, "scans placed")


def test_the_baseline_says_what_was_extrapolated_and_what_is_wrong(scenario_alone: dict[str, Any]) -> None:
    text = shown(scenario_alone | {"plain": [PLAIN, PLAIN | {"gates": [0.05], "pairs_run": 861}]})
    assert "correspondences within 60, 5 cm" in text
    assert text.count("extrapolated") == 1
    assert "412, 13.2 times ours" in text
    assert "90, 21 of them over 10 cm off" in text
    assert "61 pairs: median 0.41 cm, 0.020 degrees; 95% within 1.92 cm, 0.110 degrees" in text


def test_real_scans_that_were_joined_wrongly_are_told(scenario_alone: dict[str, Any]) -> None:
    text = shown(scenario_alone | {"real": REAL})
    assert "1.4 cm, 0.21 degrees" in row(text, "room_scan")
    assert "no" in row(text, "corridor_pair").split()
    assert "4 of 5" in row(text, "kinect_pairwise")
    assert "yes: wrong" in row(text, "a.pcd + b.ply")
