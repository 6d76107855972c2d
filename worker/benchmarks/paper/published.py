"""What the paper prints: its experiments and its results, from `published.json` beside this file."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from worker.benchmarks.paper.experiment import Experiment


@cache
def published() -> dict[str, Any]:
    """The whole file; its source stands in it."""
    found: dict[str, Any] = json.loads(
        files("worker.benchmarks.paper").joinpath("published.json").read_text("utf-8")
    )
    return found


def experiments() -> tuple[Experiment, ...]:
    """The fourteen of Table 4, in its order."""
    return tuple(Experiment(**row) for row in published()["experiments"])
