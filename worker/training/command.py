"""The command that a checkpoint's settings stand for, as its card tells it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from worker.training.options import OPTIONS
from worker.training.settings import PAPER, TrainSettings


def training_command(settings: Mapping[str, Any]) -> str:
    """Return the call of `spicd-worker train` that has the settings of a checkpoint, as `whole` returns them."""
    paper = not settings["initialize_head"]
    default = asdict(PAPER if paper else TrainSettings())
    words = ["spicd-worker", "train", "FOLDER", *(["--paper"] if paper else [])]
    for option in OPTIONS:
        value, usual = (
            _values((there["pairs"] if option.of_pairs else there)[option.name])
            for there in (settings, default)
        )
        if value != usual:
            told = [without_place(one) for one in value] if option.name == "start_from" else value
            words += [option.flag, *([] if option.kind is bool else map(str, told))]
    return " ".join(words)


def without_place(path: str | None) -> str | None:
    """Return folder and file of a path, for where on a machine these lay is nobody else's matter."""
    return None if path is None else "/".join(Path(path).parts[-2:])


def _values(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]
