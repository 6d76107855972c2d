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

OURS, OTHERS, RULES = "a" * 64, "b" * 64, "c" * 64
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
        parts = {
            "removals": figures(f1 - 0.1),
            "false_positives_with_no_change": {"validation_threshold": 2, "test_threshold": 1},
        }
        return {"method": name, "threshold": 0.3, **figures(f1), **best, **areas, **parts, "seconds": 1.0}

    def experiment(name: str, operation: str | None, f1: float | None) -> dict[str, Any]:
        row = figures(0.0, false_positives=2, at_test_threshold=figures(0.0, false_positives=1))
        return {**row, "name": name, "operation": operation, "f1": f1}

    return {
        "command": "spicd-worker evaluate paper",
        "sha256": OURS,
        "fingerprint": OURS,
        "settings": {"seed": 1, "validation_seed": 101, "everywhere": False},
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
            "fingerprint": sha256 or (RULES if name == "rule/1" else None),
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
        "seeds": {"test": 1, "validation": 2, "hard": 3},
        "test": {"visits": 48, "changed": 300, "unchanged": 4000},
        "validation": {"visits": 40},
        "methods": [
            method("a", 0.3, OTHERS),
            ours | {"hard": method("b", 0.2, OURS, told)},
            method("rule/1", 0.5, None),
            method("C2C (mean)", 0.4, None),
        ],
    }


def real_told(fingerprint: str = OURS) -> dict[str, Any]:
    """As `evaluate real` writes it, of two models and two pairs, one of them of equal scans."""

    def model(name: str, fingerprint: str) -> dict[str, Any]:
        told = {"pairs": 32, "things": 100, "found": 70, "recall": 0.7, "objects": 80, "precision": 0.9}
        known = {"model": name, "sha256": fingerprint, "fingerprint": fingerprint}
        return {**known, **told, "false_objects_a_pair": 0.1, "tiles": figures(0.8)}

    answers = [
        {"model": name, "tiles": {"changed": 2, "unchanged": 9}} for name in ("spicd-net/7", "other/1")
    ]
    return {
        "command": "spicd-worker evaluate real data",
        "data": {"files": "d" * 64, "draws": 2, "whole": True},
        "pairs": [{"same_scans": same, "answers": answers} for same in (True, False)],
        "edited": {"models": [model("spicd-net/7", fingerprint), model("other/1", OTHERS)]},
    }


def speed_told(device: str = "cpu") -> dict[str, Any]:
    """As `evaluate speed` writes it, of one model and one baseline."""

    def method(name: str, fingerprint: str | None) -> dict[str, Any]:
        known = {"model": name, "sha256": fingerprint, "fingerprint": fingerprint, "tiles": 172}
        known["precision"] = None
        seconds = {"median": 2.0, "least": 1.0, "most": 3.0}
        ratios = {"times_c2c": 4.0, "times_c2c_of_processor": 5.0}
        return {**known, "seconds": seconds, "processor_seconds": seconds, **ratios}

    machine = {"processor": "one", "device": device, "cores_used": 2, "load_before": 0.1}
    return {
        "command": "spicd-worker evaluate speed",
        "data": {"corridor": 1, "tiles": 172},
        "machine": machine,
        "methods": [method("M3C2-approx", None), method("spicd-net/7", OURS)],
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
    assert section["removals"] == {"precision": 0.8, "recall": 0.7, "f1": 0.64}
    assert section["baselines"]["M3C2"]["removals"]["f1"] == pytest.approx(0.5)
    assert section["f1_by_experiment"] == {"type_remove": 0.64}
    assert [(row["disturbance"], row["level"], row["f1"]) for row in section["robustness"]] == [
        ("jitter (mm)", 10, 0.7)
    ]
    assert section["f1_by_kind"] == {"remove": {"f1": 0.64, "f1_at_test_threshold": 0.65}}
    assert section["false_positives_with_no_change"] == {"validation_threshold": 2, "test_threshold": 1}
    assert {name: row["f1"] for name, row in section["baselines"].items()} == {"C2C (mean)": 0.5, "M3C2": 0.6}


def test_a_file_of_an_earlier_release_is_taken_with_what_it_says(store: Path) -> None:
    earlier = paper_told()
    del earlier["fingerprint"]
    for row in earlier["table_6"]:
        del row["removals"], row["false_positives_with_no_change"]
    section = paper_figures(earlier, open_card(store, "spicd-net/7"))
    assert section["removals"]["f1"] == 0.64
    assert "removals" not in section["baselines"]["M3C2"]


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


def test_a_model_without_weights_goes_by_its_settings(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = open_card(store, "spicd-net/7").model_copy(update={"name": "rule", "version": "1", "sha256": None})
    with pytest.raises(ValueError, match=f"not with the card's {card.fingerprint}"):
        revisit_figures(revisit_told(), card)
    monkeypatch.setattr(f"{__name__}.RULES", card.fingerprint)
    section = revisit_figures(revisit_told(), card)
    assert (section["f1"], section["sha256"], section["fingerprint"]) == (0.5, None, card.fingerprint)
    assert list(section["baselines"]) == ["C2C (mean)"]
    paper = {**paper_told(), "sha256": None, "fingerprint": card.fingerprint}
    assert paper_figures(paper, card)["f1"] == 0.85
    other = card.model_copy(update={"detector_settings": {"patch_points": 9}})
    measured = card.model_copy(update={"evaluation": {"paper": paper_figures(paper, card)}})
    assert outdated_sections(measured) == []
    assert outdated_sections(other.model_copy(update={"evaluation": measured.evaluation})) == ["paper"]


def test_every_section_says_by_what_command_and_on_what_it_was_measured(store: Path) -> None:
    told = {"paper": paper_told(), "revisit": revisit_told(), "real": real_told(), "speed": speed_told()}
    assert record(store, **told) == 0
    evaluation = open_card(store, "spicd-net/7").evaluation
    for name, document in told.items():
        assert evaluation[name]["command"] == document["command"]
        assert (evaluation[name]["sha256"], evaluation[name]["fingerprint"]) == (OURS, OURS)
    assert evaluation["paper"]["data"] == {
        "corridor": 1,
        "validation_corridor": 101,
        "experiments": 2,
        "everywhere": False,
    }
    assert evaluation["revisit"]["data"]["validation_visits"] == 40
    assert evaluation["real"]["data"]["files"] == "d" * 64
    assert evaluation["real"]["found"] == 70
    assert (evaluation["real"]["tiles_changed_between_equal_scans"]) == 2
    assert evaluation["real"]["tiles_of_equal_scans"] == 11
    assert evaluation["speed"]["seconds"]["median"] == 2.0
    assert list(evaluation["speed"]["baselines"]) == ["M3C2-approx"]


def test_a_speed_on_a_gpu_stands_beside_that_on_the_processor(store: Path) -> None:
    record(store, speed=speed_told())
    record(store, speed=speed_told("NVIDIA"))
    evaluation = open_card(store, "spicd-net/7").evaluation
    assert (evaluation["speed"]["machine"]["device"]) == "cpu"
    assert evaluation["speed_on_gpu"]["machine"]["device"] == "NVIDIA"


@pytest.mark.parametrize(
    ("told", "sentence"),
    [
        ({"paper": {**paper_told(), "sha256": OTHERS, "fingerprint": OTHERS}}, f"weights {OTHERS}"),
        ({"real": real_told(OTHERS)}, f"weights {OTHERS}"),
        ({"real": {**real_told(), "data": {"whole": False}}}, "--place"),
        ({"speed": {**speed_told(), "methods": speed_told()["methods"][:1]}}, "not spicd-net/7"),
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
