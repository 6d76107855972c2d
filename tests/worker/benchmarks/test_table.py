"""The table says what the cards say, names what nobody measured, and refuses figures of other weights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from worker.benchmarks.paper.experiments import published
from worker.benchmarks.table import (
    BEGIN,
    COLUMNS,
    END,
    MISSING,
    NOT_PRINTED,
    PRINTED,
    Measured,
    measured,
    write_table,
)
from worker.cli import main
from worker.detectors.card import MODEL_STORE, BaseRecord, Card, Preprocessing
from worker.detectors.store import write_card, write_model

ROOT = Path(__file__).resolve().parents[3]
NEEDS = Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512)


def card(name: str, **more: Any) -> Card:
    known = {"name": name, "version": "1", "detector": name, "summary": "", "threshold": 0.5}
    return Card(**known, preprocessing=NEEDS, **more)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A network of 15 parameters, measured in the paper's experiments, and a method without weights."""
    folder = tmp_path / "store" / "pointnet2" / "1"
    weights = {
        "layer.weight": torch.zeros(3, 4),
        "layer.bias": torch.zeros(3),
        "layer.running_mean": torch.zeros(3),
        "layer.running_var": torch.zeros(3),
    }
    write_model(folder, card("pointnet2", weights="weights.safetensors"), weights)
    (folder / "epochs.csv").write_text("epoch,seconds\n1,60.0\n2,120.0\n")
    bare = tmp_path / "store" / "c2c" / "1"
    bare.mkdir(parents=True)
    write_card(bare, card("c2c"))
    measure(tmp_path / "store", "pointnet2")
    return tmp_path / "store"


def measure(store: Path, name: str, **more: Any) -> None:
    """Put figures of the fourteen experiments on a card, with the weights that it has."""
    path = store / name / "1" / "card.json"
    document = json.loads(path.read_text())
    removals = {"precision": 0.9, "recall": 0.55, "f1": 0.65}
    quiet = {"validation_threshold": 3, "test_threshold": 4}
    document["evaluation"]["paper"] = {
        "command": "spicd-worker evaluate paper --model pointnet2/1",
        "sha256": document["sha256"],
        "data": {"corridor": 1},
        "f1": 0.876,
        "at_test_threshold": {"f1": 0.88},
        "removals": removals,
        "false_positives_with_no_change": quiet,
        "baselines": {"M3C2": {"f1": 0.6, "f1_at_test_threshold": 0.61, "removals": removals}},
        **more,
    }
    path.write_text(json.dumps(document))


@pytest.fixture
def page(tmp_path: Path) -> Path:
    path = tmp_path / "page.md"
    path.write_text(f"# Above\n\n{BEGIN}\nold\n{END}\n\nbelow\n")
    return path


def rows_of(page: Path) -> dict[str, dict[str, str]]:
    """Read the first table of a page: by its first column, each cell by what stands above it."""
    table = [line for line in page.read_text().split("Where these")[0].splitlines() if line.startswith("|")]
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    return {row[0]: dict(zip(head, row, strict=True)) for row in rows}


def run(*words: str) -> int:
    try:
        main(["evaluate", "table", *words])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_a_row_has_the_cards_figures_its_weights_and_what_it_is_made_of(store: Path, page: Path) -> None:
    assert write_table(page, store)
    row = rows_of(page)["`pointnet2/1`"]
    sha256 = json.loads((store / "pointnet2/1/card.json").read_text())["sha256"]
    assert row["weights"] == f"`{sha256[:12]}`"
    assert row["fourteen experiments: F1"] == "0.88 (0.88)"
    assert row["removals: F1, recall"] == "0.65, 0.55"
    assert row["false alarms with nothing changed"] == "3"
    assert (row["parameters"], row["training"]) == ("15", "2 min")
    text = page.read_text()
    assert text.startswith("# Above\n\n")
    assert text.endswith("\n\nbelow\n")
    assert f"| `spicd-worker evaluate paper --model pointnet2/1` | corridor 1 | `{sha256}` |" in text


def test_a_model_on_anothers_encoder_has_the_parameters_and_the_training_of_both(
    store: Path, page: Path
) -> None:
    sha256 = json.loads((store / "pointnet2/1/card.json").read_text())["sha256"]
    head = card("pointnet2", weights="weights.safetensors", training={"head_alone": {"seconds": 60.0}})
    base = BaseRecord(model="pointnet2/1", sha256=sha256)
    head = head.model_copy(update={"version": "2", "base": base})
    write_model(store / "pointnet2" / "2", head, {"layer.bias": torch.zeros(3), "head": torch.zeros(5)})
    write_table(page, store)
    row = rows_of(page)["`pointnet2/2`"]
    assert (row["parameters"], row["training"]) == ("20", "3 min")


def test_what_nobody_measured_is_said_so_and_no_cell_is_blank(store: Path, page: Path) -> None:
    write_table(page, store)
    rows = rows_of(page)
    assert rows["`pointnet2/1`"]["second visits: tile F1"] == MISSING
    assert rows["`c2c/1`"]["fourteen experiments: F1"] == MISSING
    assert (rows["`c2c/1`"]["parameters"], rows["`c2c/1`"]["training"]) == ("none", "none")
    assert all(cell for row in rows.values() for cell in row.values())


def test_methods_without_a_card_are_taken_from_beside_a_model(store: Path, page: Path) -> None:
    write_table(page, store)
    row = rows_of(page)["M3C2"]
    assert row["fourteen experiments: F1"] == "0.60 (0.61)"
    assert row["false alarms with nothing changed"] == MISSING
    assert "beside `pointnet2/1`" in page.read_text()
    assert rows_of(page)["M3C2-approx"]["fourteen experiments: F1"] == MISSING


def test_what_the_paper_prints_stands_beside_ours(store: Path, page: Path) -> None:
    write_table(page, store)
    rows = rows_of(page)
    head = "in the paper: F1; 172 tiles on a GTX 1650"
    assert rows["`pointnet2/1`"][head] == "0.886; 131.1 s"
    assert rows["C2C (mean)"][head] == rows["`c2c/1`"][head] == "0.532; 25.8 s"
    assert rows["M3C2"][head] == NOT_PRINTED
    assert set(PRINTED.values()) == set(published()["table_6"])


def test_of_its_own_network_the_paper_prints_removals_too() -> None:
    cells = dict(COLUMNS)
    ours = Measured(name="spicd-net/2", sections={}, beside={})
    assert cells["in the paper: F1; 172 tiles on a GTX 1650"](ours) == "0.838, removals 0.62; 22.4 s"


def test_a_card_that_has_the_f1_of_removals_alone_has_no_recall(store: Path, page: Path) -> None:
    measure(store, "pointnet2", removals=None, f1_by_experiment={"type_remove": 0.63})
    write_table(page, store)
    assert rows_of(page)["`pointnet2/1`"]["removals: F1, recall"] == f"0.63, {MISSING}"


def test_figures_of_fewer_visits_are_marked(store: Path, page: Path) -> None:
    path = store / "c2c/1/card.json"
    document = json.loads(path.read_text())
    document["evaluation"]["revisit"] = {
        "command": "spicd-worker evaluate revisit --visits 16",
        "sha256": None,
        "visits": 16,
        "f1": 0.3,
        "average_precision": 0.2,
        "quiet_visits": 6,
        "quiet_visits_with_false_tile": 5,
        "objects": None,
    }
    path.write_text(json.dumps(document))
    write_table(page, store)
    row = rows_of(page)["`c2c/1`"]
    assert row["second visits: tile F1"] == "0.300 (of 16 visits alone)"
    assert (row["quiet visits with a changed tile"], row["objects: recall, precision"]) == (
        "5 of 6",
        "tells none",
    )


def test_figures_of_other_weights_and_weights_of_another_card_are_refused(store: Path, page: Path) -> None:
    before = page.read_text()
    measure(store, "pointnet2", sha256="b" * 64)
    with pytest.raises(ValueError, match="paper measured with other weights"):
        write_table(page, store)
    measure(store, "pointnet2")
    (store / "pointnet2/1/weights.safetensors").write_bytes(b"others")
    with pytest.raises(ValueError, match="not the weights that the card"):
        write_table(page, store)
    assert page.read_text() == before


def test_check_writes_nothing_and_fails_where_a_card_has_changed(
    store: Path, page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--page", str(page), "--model-store", str(store))
    assert run(*words) == 0
    assert run(*words, "--check") == 0
    measure(store, "pointnet2", f1=0.5)
    before = page.read_text()
    assert run(*words, "--check") == 1
    assert "evaluate table" in capsys.readouterr().err
    assert page.read_text() == before
    page.write_text("no markers")
    assert run(*words) == 1


def test_the_page_of_the_documentation_is_what_the_shipped_cards_say() -> None:
    assert write_table(ROOT / "docs/comparison.md", MODEL_STORE, check=True) is False


def test_every_shipped_model_and_baseline_has_a_row() -> None:
    names = [row.name for row in measured(MODEL_STORE)]
    assert {"spicd-net/1", "c2c/1", "M3C2-approx", "M3C2", "voxel-rule/1", "voxel-net/1"} <= set(names)
    assert names.index("spicd-net/1") == 0
