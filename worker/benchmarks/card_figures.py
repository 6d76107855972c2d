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


def paper_figures(document: Figures, sha256: str) -> Figures:
    """Return the figures of `evaluate paper`, JSON-ready.

    They are at the threshold that was chosen on another corridor, unless the name says otherwise. Raises
    KeyError, and ValueError for other weights or a part of the experiments.
    """
    if document["sha256"] != sha256:
        raise ValueError(f"measured with weights {document['sha256']}, and not with the card's {sha256}")
    ours, *baselines = document["table_6"]
    *experiments, whole = document["table_5"]
    if whole["paper"] is None:
        raise ValueError("measured on a part of the experiments; leave out --quick")
    return {
        "command": document["command"],
        "sha256": sha256,
        "tiles": document["map"]["tiles"],
        **_operating(ours),
        **_picked(ours, AREAS),
        "at_test_threshold": _operating(ours["at_test_threshold"], ours["test_threshold"]),
        "false_positives_with_no_change": _quiet(experiments),
        "f1_by_experiment": {row["name"]: row["f1"] for row in experiments if row["operation"]},
        "f1_by_kind": {kind: rows[ours["method"]] for kind, rows in document["by_kind"].items()},
        "baselines": {
            row["method"]: {
                **_picked(row, ("threshold", *RATIOS, *AREAS)),
                "f1_at_test_threshold": row["at_test_threshold"]["f1"],
            }
            for row in baselines
        },
    }


def revisit_figures(document: Figures, sha256: str) -> Figures:
    """Return the figures of `evaluate revisit`, JSON-ready.

    They are at the threshold that was chosen on other buildings, unless the name says otherwise. Raises KeyError,
    and ValueError where no method had these weights.
    """
    measured = [row["sha256"] for row in document["methods"] if row["sha256"] is not None]
    if sha256 not in measured:
        raise ValueError(f"measured with weights {', '.join(measured)}, and not with the card's {sha256}")
    ours = next(row for row in document["methods"] if row["sha256"] == sha256)
    test = document["test"]
    return {
        "command": document["command"],
        "sha256": sha256,
        "visits": test["visits"],
        "tiles": test["observed"],
        "changed_tiles": test["changed"]["counted"],
        **_visited(ours),
        **_picked(ours["chosen"], COUNTS),
        "at_test_threshold": _operating(ours["best"]),
        "recall_by_kind": {kind: counts["recall"] for kind, counts in ours["groups"]["kind"].items()},
        "baselines": {row["name"]: _visited(row) for row in document["methods"] if row["sha256"] is None},
    }


SECTIONS: dict[str, Callable[[Figures, str], Figures]] = {"paper": paper_figures, "revisit": revisit_figures}


def _section(name: str, path: Path, card: Card) -> Figures:
    if card.sha256 is None:
        raise ValueError(f"model {card.name}/{card.version} has no weights that were measured")
    try:
        return SECTIONS[name](json.loads(path.read_text(encoding="utf-8")), card.sha256)
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
        **_picked(row, (*AREAS, "unchanged_visits", "unchanged_visits_with_false_alarm")),
    }


def _picked(row: Figures, names: tuple[str, ...]) -> Figures:
    return {name: row[name] for name in names}
