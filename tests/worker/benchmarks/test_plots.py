"""The picture of a training's log."""

from __future__ import annotations

from pathlib import Path

import pytest

from worker.benchmarks.plots import CURVES, draw_curves, read_log
from worker.training.log import LOG


def write_log(folder: Path, text: str) -> Path:
    (folder / LOG).write_text(text)
    return folder


@pytest.mark.slow
def test_the_picture_lies_beside_the_log_and_is_drawn_anew_after_each_epoch(tmp_path: Path) -> None:
    head = "epoch,train_loss,train_accuracy,validation_loss,accuracy\n"
    draw_curves(write_log(tmp_path, head + "1,0.2,0.4,0.21,0.45\n"))
    first = (tmp_path / CURVES).read_bytes()
    assert first.startswith(b"\x89PNG")
    draw_curves(write_log(tmp_path, head + "1,0.2,0.4,0.21,0.45\n2,0.1,0.7,0.12,0.66\n"))
    assert (tmp_path / CURVES).read_bytes() != first
    assert sorted(path.name for path in tmp_path.iterdir()) == [CURVES, LOG]


def test_a_log_from_before_training_accuracy_was_kept_is_drawn_without(tmp_path: Path) -> None:
    text = "epoch,train_loss,train_accuracy,validation_loss,accuracy\n1,0.2,,0.21,0.45\n2,0.1,0.7,0.12,0.66\n"
    folder = write_log(tmp_path, text)
    assert set(read_log(folder / LOG)[0]) == {
        "epoch",
        "train_loss",
        "validation_loss",
        "accuracy",
    }
    draw_curves(folder)
    assert (folder / CURVES).exists()


def test_a_log_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="could not convert"):
        draw_curves(write_log(tmp_path, "epoch,train_loss\n1,much\n"))
