"""What a card says of the two benchmarks: the figures that matter out of their files, and what made them.

A section has the weights' sha256, so that nobody takes the figures of one network for those of another.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from worker.detectors.card import Card
from worker.detectors.store import open_card, write_card

Figures = dict[str, Any]  #: JSON-ready

COUNTS = ("true_positives", "false_positives", "false_negatives", "true_negatives")
RATIOS = ("precision", "recall", "f1", "accuracy")
AREAS = ("area_under_roc", "average_precision")
#: Of the objects, where a method tells them.
OBJECTS = (
    "regions", "recall", "recall_interval", "objects", "precision", "precision_interval", "false_objects",
    "false_objects_a_quiet_visit", "quiet_visits_with_an_object", "moved", "told_as_moved",
)  # fmt: skip


def record_figures(model_store: Path, model: str, files: Mapping[str, Path]) -> Path:
    """Put the benchmarks' `files`, `paper` or `revisit`, on the model's card; returns the card.

    What else stands in its evaluation is kept. Raises DetectorUnavailable, OSError, and ValueError for a file that is
    no such benchmark's, or was made with other weights.
    """
    card = open_card(model_store, model)
    sections = {name: _section(name, path, card) for name, path in files.items()}
    folder = model_store / model
    write_card(folder, card.model_copy(update={"evaluation": {**card.evaluation, **sections}}))
    return folder / "card.json"


def outdated_sections(card: Card) -> list[str]:
    """Name the benchmarks on this card that were measured with other weights than its own."""
    measured = {name: card.evaluation[name] for name in SECTIONS if name in card.evaluation}
    return [name for name, section in measured.items() if section.get("sha256") != card.sha256]


def paper_figures(document: Figures, card: Card) -> Figures:
    """Return the figures of `evaluate paper`, JSON-ready.

    They are at the threshold that was chosen on another corridor, unless the name says otherwise. Raises
    KeyError, and ValueError for other weights or a part of the experiments.
    """
    if card.sha256 is None:
        raise ValueError(f"model {card.model} has no weights that were measured")
    if document["sha256"] != card.sha256:
        raise ValueError(f"measured with weights {document['sha256']}, and not with the card's {card.sha256}")
    ours, *baselines = document["table_6"]
    *experiments, whole = document["table_5"]
    if whole["paper"] is None:
        raise ValueError("measured on a part of the experiments; leave out --quick")
    return {
        "command": document["command"],
        "sha256": card.sha256,
        "tiles": document["map"]["tiles"],
        **_operating(ours),
        **_picked(ours, AREAS),
        "at_test_threshold": _operating(ours["at_test_threshold"], ours["test_threshold"]),
        "false_positives_with_no_change": _quiet(experiments),
        "f1_by_experiment": {row["name"]: row["f1"] for row in experiments if row["operation"]},
        "robustness": [
            _picked(row, ("disturbance", "level", "precision", "recall", "f1", "false_positive_rate"))
            for row in document["robustness"]
        ],
        "f1_by_kind": {kind: rows[ours["method"]] for kind, rows in document["by_kind"].items()},
        "baselines": {
            row["method"]: {
                **_picked(row, ("threshold", *RATIOS, *AREAS)),
                "f1_at_test_threshold": row["at_test_threshold"]["f1"],
            }
            for row in baselines
        },
    }


def revisit_figures(document: Figures, card: Card) -> Figures:
    """Return the figures of `evaluate revisit`, JSON-ready; a model without weights goes by its name.

    They are at the threshold that was chosen on other buildings, unless the name says otherwise. Raises KeyError,
    and ValueError where no method was this model.
    """
    ours = [
        row
        for row in document["methods"]
        if row["sha256"] == card.sha256 and (card.sha256 is not None or row["name"] == card.model)
    ]
    if not ours:
        measured = [str(row["sha256"] or row["name"]) for row in document["methods"]]
        raise ValueError(
            f"measured with weights {', '.join(measured)}, and not with the card's {card.sha256}"
        )
    test = document["test"]
    return {
        "command": document["command"],
        "sha256": card.sha256,
        "visits": test["visits"],
        "changed_tiles": test["changed"],
        "unchanged_tiles": test["unchanged"],
        **_visited(ours[0]),
        **_picked(ours[0]["chosen"], COUNTS),
        "at_test_threshold": _operating(ours[0]["best"]),
        "recall_by_kind": {kind: counts["recall"] for kind, counts in ours[0]["groups"]["kind"].items()},
        "recall_by_case": {case: counts["recall"] for case, counts in ours[0]["groups"]["case"].items()},
        "calibration": ours[0]["calibration"],
        "hard": _visited(ours[0]["hard"]) if "hard" in ours[0] else None,
        "baselines": {
            row["name"]: _visited(row)
            for row in document["methods"]
            if row["sha256"] is None and row is not ours[0]
        },
    }


SECTIONS: dict[str, Callable[[Figures, Card], Figures]] = {"paper": paper_figures, "revisit": revisit_figures}


def _section(name: str, path: Path, card: Card) -> Figures:
    try:
        return SECTIONS[name](json.loads(path.read_text(encoding="utf-8")), card)
    except (KeyError, IndexError, TypeError, AttributeError) as missing:
        raise ValueError(f"{path} is no result of `spicd-worker evaluate {name}`: {missing!r}") from missing
    except ValueError as other:
        raise ValueError(f"{path}: {other}") from other


def _operating(row: Figures, threshold: float | None = None) -> Figures:
    return {
        "threshold": row["threshold"] if threshold is None else threshold,
        **_picked(row, (*RATIOS, *COUNTS)),
    }


def _quiet(experiments: list[Figures]) -> Figures:
    """Return the false positives of the experiment without a change, at both thresholds."""
    row = next(row for row in experiments if row["operation"] is None)
    return {
        "validation_threshold": row["false_positives"],
        "test_threshold": row["at_test_threshold"]["false_positives"],
    }


def _visited(row: Figures) -> Figures:
    """Return what stands side by side for every method of the revisits."""
    return {
        **_picked(row["chosen"], ("threshold", *RATIOS, "false_positive_rate", "f1_interval")),
        **_picked(
            row, (*AREAS, "quiet_visits", "quiet_visits_with_false_tile", "quiet_visits_with_false_alarm")
        ),
        "objects": None if row["objects"] is None else _picked(row["objects"], OBJECTS),
    }


def _picked(row: Figures, names: tuple[str, ...]) -> Figures:
    return {name: row[name] for name in names}
