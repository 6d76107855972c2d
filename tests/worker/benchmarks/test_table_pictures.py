"""The pictures beside the table show what the cards and the logs say, and leave out what nobody measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from worker.benchmarks.paper.experiments import published
from worker.benchmarks.table import Measured, measured
from worker.benchmarks.table_pictures import disturbances, experiments, training, write_pictures
from worker.cli import main
from worker.detectors.card import MODEL_STORE

ROOT = Path(__file__).resolve().parents[3]
LOG = "epoch,seconds,train_loss,validation_loss\n1,60,0.3,0.4\n2,120,0.2,0.1\n"


def row(name: str, **paper: object) -> Measured:
    return Measured(name=name, sections={"paper": paper} if paper else {}, beside={})


def test_each_experiment_stands_beside_the_papers() -> None:
    figure = experiments([row("a/1", f1_by_experiment={"type_add": 0.9, "type_remove": None}), row("b/1")])
    assert figure is not None
    ours, theirs = figure.axes[0].lines
    assert (ours.get_label(), theirs.get_label()) == ("a/1", "SPICD-Net in the paper")
    assert np.asarray(ours.get_xdata()).tolist() == ["type_add", "type_remove"]
    assert np.array_equal(np.asarray(ours.get_ydata(), float), [0.9, np.nan], equal_nan=True)
    assert np.asarray(theirs.get_ydata())[1] == published()["table_5"]["type_remove"]["f1"]


def test_each_disturbance_has_its_plot_and_the_papers_points_are_on_that_of_lost_points() -> None:
    points = [
        {"disturbance": kind, "level": level, "f1": 1 - level / 100}
        for kind in ("jitter (mm)", "dropout (%)")
        for level in (0, 10)
    ]
    figure = disturbances([row("a/1", robustness=points), row("b/1", robustness=[])])
    assert figure is not None
    jitter, dropout = figure.axes
    assert [line.get_label() for line in jitter.lines] == ["a/1"]
    assert [line.get_label() for line in dropout.lines] == ["a/1", "paper"]
    assert jitter.lines[0].get_ydata() == pytest.approx([1.0, 0.9])


def test_each_log_of_a_training_has_its_plot(tmp_path: Path) -> None:
    for name in ("a/1/epochs.csv", "b/1/epochs-blind.csv", "b/1/head_epochs.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(LOG)
    figure = training([row("a/1"), row("b/1"), row("c/1")], tmp_path)
    assert figure is not None
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "a/1, epochs",
        "b/1, epochs blind",
        "b/1, head epochs",
    ]
    assert figure.axes[0].lines[1].get_ydata() == pytest.approx([0.4, 0.1])


def test_nothing_is_drawn_of_what_nobody_measured(tmp_path: Path) -> None:
    assert write_pictures(tmp_path / "pictures", [row("a/1")], tmp_path) == []
    assert list((tmp_path / "pictures").iterdir()) == []


def test_the_command_writes_the_pictures_that_the_page_shows(tmp_path: Path) -> None:
    text = (ROOT / "docs/comparison.md").read_text()
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(SystemExit, match="0"):
        main(["evaluate", "table", "--page", str(page)])
    written = sorted(path.name for path in (tmp_path / "pictures").iterdir())
    assert written == [f"comparison-{name}.png" for name in ("disturbances", "experiments", "training")]
    assert all(f"pictures/{name}" in text for name in written)
    assert measured(MODEL_STORE)
