"""What a card says of the benchmarks was measured with the weights that it vouches for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from worker.benchmarks.card_figures import OBJECTS, outdated_sections, paper_figures, revisit_figures
from worker.cli import main
from worker.detectors.card import MODEL_STORE, Card, Preprocessing
from worker.detectors.store import open_card, read_card, write_card

OURS, OTHERS = "a" * 64, "b" * 64
CARDS = sorted(MODEL_STORE.glob("*/*/card.json"))


def figures(f1: float, **more: Any) -> dict[str, Any]:
    counts = dict.fromkeys(("true_positives", "false_positives", "false_negatives", "true_negatives"), 7)
    rates = {"precision": 0.8, "recall": 0.7, "accuracy": 0.9, "false_positive_rate": 0.1}
    return {"f1": f1, **rates, **counts, "unobserved": 3, **more}


def paper_told() -> dict[str, Any]:
    """As `evaluate paper` writes it, with two of its experiments."""

    def method(name: str, f1: float) -> dict[str, Any]:
        best = {"test_threshold": 0.4, "at_test_threshold": figures(f1 + 0.01)}
        areas = {"area_under_roc": 0.95, "average_precision": 0.9}
        return {"method": name, "threshold": 0.3, **figures(f1), **best, **areas, "seconds": 1.0}

    def experiment(name: str, operation: str | None, f1: float | None) -> dict[str, Any]:
        row = figures(0.0, false_positives=2, at_test_threshold=figures(0.0, false_positives=1))
        return {**row, "name": name, "operation": operation, "f1": f1}

    return {
        "command": "spicd-worker evaluate paper",
        "sha256": OURS,
        "map": {"tiles": 160},
        "table_5": [
            experiment("type_remove", "remove", 0.64),
            experiment("baseline_no_change", None, None),
            {"name": "aggregated", "paper": {"f1": 0.84}},
        ],
        "table_6": [method("spicd-net/1", 0.85), method("C2C (mean)", 0.5), method("M3C2", 0.6)],
        "robustness": [figures(0.7, disturbance="jitter (mm)", level=10)],
        "by_kind": {"remove": {"spicd-net/1": {"f1": 0.64, "f1_at_test_threshold": 0.65}, "M3C2": {"f1": 0}}},
    }


def revisit_told() -> dict[str, Any]:
    """As `evaluate revisit` writes it, two checkpoints, a model without weights and a baseline in it."""

    def method(name: str, f1: float, sha256: str | None, objects: Any = None) -> dict[str, Any]:
        return {
            "name": name,
            "sha256": sha256,
            "chosen": figures(f1, threshold=0.2, f1_interval=[f1 - 0.1, f1 + 0.1]),
            "best": figures(f1 + 0.01, threshold=0.3),
            "area_under_roc": 0.9,
            "average_precision": 0.8,
            "quiet_visits": 8,
            "quiet_visits_with_false_tile": 4,
            "quiet_visits_with_false_alarm": 5,
            "groups": {
                "kind": {"add": figures(0.0), "move": figures(0.0)},
                "case": {"single": figures(0.0)},
            },
            "objects": objects,
            "calibration": {"tiles": {"expected_calibration_error": 0.02}, "voxels": None},
        }

    told: dict[str, Any] = {**dict.fromkeys(OBJECTS, 0.9), "groups": {}}
    ours = method("b", 0.6, OURS, told)
    return {
        "command": "spicd-worker evaluate revisit --weights a.pt --weights b.pt",
        "test": {"visits": 48, "changed": 300, "unchanged": 4000},
        "methods": [
            method("a", 0.3, OTHERS),
            ours | {"hard": method("b", 0.2, OURS, told)},
            method("rule/1", 0.5, None),
            method("C2C (mean)", 0.4, None),
        ],
    }


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """One model, spicd-net/7, that was measured on something already."""
    needs = Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512)
    card = Card(
        name="spicd-net",
        version="7",
        detector="spicd-net",
        summary="for tests",
        threshold=0.5,
        preprocessing=needs,
        detector_settings={"patch_points": 4096, "seed": 42},
        sha256=OURS,
        evaluation={"validation": {"f1": 0.5}},
    )
    folder = tmp_path / "store" / "spicd-net" / "7"
    folder.mkdir(parents=True)
    write_card(folder, card)
    return tmp_path / "store"


def record(store: Path, **told: Any) -> int:
    words = []
    for name, document in told.items():
        path = store.parent / f"{name}.json"
        path.write_text(document if isinstance(document, str) else json.dumps(document))
        words += [f"--{name}", str(path)]
    try:
        main(["evaluate", "record", "--model", "spicd-net/7", "--model-store", str(store), *words])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_both_benchmarks_come_on_the_card_and_the_rest_of_it_stays(store: Path) -> None:
    before = read_card(store / "spicd-net" / "7")
    assert record(store, paper=paper_told(), revisit=revisit_told()) == 0
    after = read_card(store / "spicd-net" / "7")
    assert set(after.evaluation) == {"validation", "paper", "revisit"}
    assert after.evaluation["validation"] == {"f1": 0.5}
    assert after.model_copy(update={"evaluation": before.evaluation}) == before
    assert outdated_sections(after) == []


def test_the_paper_section_has_both_thresholds_the_kinds_and_the_baselines(store: Path) -> None:
    section = paper_figures(paper_told(), open_card(store, "spicd-net/7"))
    assert (section["command"], section["sha256"]) == ("spicd-worker evaluate paper", OURS)
    assert (section["threshold"], section["f1"], section["true_positives"]) == (0.3, 0.85, 7)
    assert section["at_test_threshold"]["threshold"] == 0.4
    assert section["at_test_threshold"]["f1"] == pytest.approx(0.86)
    assert section["f1_by_experiment"] == {"type_remove": 0.64}
    assert [(row["disturbance"], row["level"], row["f1"]) for row in section["robustness"]] == [
        ("jitter (mm)", 10, 0.7)
    ]
    assert section["f1_by_kind"] == {"remove": {"f1": 0.64, "f1_at_test_threshold": 0.65}}
    assert section["false_positives_with_no_change"] == {"validation_threshold": 2, "test_threshold": 1}
    assert {name: row["f1"] for name, row in section["baselines"].items()} == {"C2C (mean)": 0.5, "M3C2": 0.6}


def test_the_revisit_section_is_of_the_method_with_the_cards_weights(store: Path) -> None:
    section = revisit_figures(revisit_told(), open_card(store, "spicd-net/7"))
    assert section["command"] == "spicd-worker evaluate revisit --weights a.pt --weights b.pt"
    assert (section["visits"], section["changed_tiles"], section["unchanged_tiles"]) == (48, 300, 4000)
    assert (section["f1"], section["f1_interval"]) == (0.6, [0.5, 0.7])
    assert section["at_test_threshold"]["threshold"] == 0.3
    assert (section["quiet_visits"], section["quiet_visits_with_false_alarm"]) == (8, 5)
    assert section["recall_by_kind"] == {"add": 0.7, "move": 0.7}
    assert section["recall_by_case"] == {"single": 0.7}
    assert (section["objects"]["recall"], section["hard"]["f1"]) == (0.9, 0.2)
    assert section["calibration"]["tiles"]["expected_calibration_error"] == 0.02
    assert list(section["baselines"]) == ["rule/1", "C2C (mean)"]
    assert section["baselines"]["C2C (mean)"]["area_under_roc"] == 0.9


def test_a_model_without_weights_goes_by_its_name(store: Path) -> None:
    card = open_card(store, "spicd-net/7").model_copy(update={"name": "rule", "version": "1", "sha256": None})
    section = revisit_figures(revisit_told(), card)
    assert (section["f1"], section["sha256"]) == (0.5, None)
    assert list(section["baselines"]) == ["C2C (mean)"]
    with pytest.raises(ValueError, match="no weights"):
        paper_figures(paper_told(), card)


@pytest.mark.parametrize(
    ("told", "sentence"),
    [
        ({"paper": {**paper_told(), "sha256": OTHERS}}, f"weights {OTHERS}"),
        ({"paper": {**paper_told(), "table_5": [{"name": "aggregated", "paper": None}]}}, "--quick"),
        ({"revisit": {**revisit_told(), "methods": revisit_told()["methods"][:1]}}, f"weights {OTHERS}"),
        ({"revisit": paper_told()}, "no result of `spicd-worker evaluate revisit`"),
        ({"paper": [1, 2]}, "no result of `spicd-worker evaluate paper`"),
        ({"paper": "no JSON"}, "paper.json"),
        ({}, "--paper, --revisit"),
    ],
)
def test_what_is_no_measurement_of_this_model_is_refused_and_the_card_stays(
    store: Path, told: dict[str, Any], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    card = store / "spicd-net" / "7" / "card.json"
    before = card.read_bytes()
    assert record(store, **told) == 1
    assert sentence in capsys.readouterr().err
    assert card.read_bytes() == before


def test_figures_left_over_from_other_weights_are_found(store: Path) -> None:
    record(store, paper=paper_told(), revisit=revisit_told())
    card = open_card(store, "spicd-net/7")
    assert outdated_sections(card.model_copy(update={"sha256": OTHERS})) == ["paper", "revisit"]


@pytest.mark.parametrize("path", CARDS, ids=lambda path: "/".join(path.parts[-3:-1]))
def test_the_shipped_cards_have_no_figures_of_other_weights(path: Path) -> None:
    assert outdated_sections(read_card(path.parent)) == []
