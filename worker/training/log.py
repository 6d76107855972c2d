"""The log of a training: CSV, a row an epoch."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Self

from worker.files import write_atomically
from worker.metrics import ClassFigures

LOG = "epochs.csv"
HEAD_LOG = "head_epochs.csv"  #: of what the head was trained on its own
CLASSES = ("unchanged", "changed", "different")


@dataclass(frozen=True, kw_only=True, slots=True)
class EpochRow:
    """One line of the log."""

    epoch: int
    seconds: float  #: since the run began, stops left out
    learning_rate: float  #: at the epoch's end
    train_loss: float
    train_accuracy: float  #: of the network as it was at each step, dropout included
    validation_loss: float
    accuracy: float  #: on the validation pairs
    precision_unchanged: float
    precision_changed: float
    precision_different: float
    recall_unchanged: float
    recall_changed: float
    recall_different: float

    @classmethod
    def of(cls, figures: ClassFigures, **others: float) -> Self:
        """Return a row with the figures of the validation pairs; `others` are the columns up to them."""
        by_class = {
            f"{ratio}_{name}": value
            for ratio in ("precision", "recall")
            for name, value in zip(CLASSES, getattr(figures, ratio), strict=True)
        }
        return cls(validation_loss=figures.loss, accuracy=figures.accuracy, **by_class, **others)  # type: ignore[arg-type]


def append_row(folder: Path, row: EpochRow, name: str = LOG) -> None:
    """Write one more row, and the columns' names first where there is no log yet."""
    path = folder / name
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(asdict(row)))
        if fresh:
            writer.writeheader()
        writer.writerow(asdict(row))


def cut_log(folder: Path, epochs: int) -> None:
    """Take out what was written of later epochs, whose checkpoint was not, and half a row; in today's columns."""
    path = folder / LOG
    if not path.exists():
        return
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if None not in row.values()]

    def write(aside: Path) -> None:
        with aside.open("w", newline="") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(EpochRow)], extrasaction="ignore")
            writer.writeheader()
            writer.writerows(row for row in rows if int(row["epoch"]) <= epochs)

    write_atomically(path, write)
