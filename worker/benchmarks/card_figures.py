"""What a card says of the benchmarks: the figures that matter out of their files, and what made them.

Every section begins alike: `command`, `sha256` of the weights (None: a model without), `fingerprint` (the same, or
without weights that of its settings) and `data`, what it was measured on, by seeds and counts. So nobody takes the
figures of one network for those of another, and `worker.benchmarks.table` can set all of them side by side.
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
#: Of the removals in the paper's experiments.
REMOVALS = ("precision", "recall", "f1")
#: What files of `evaluate paper` of release 0.3 and before do not say of the baselines.
LATER = ("removals", "false_positives_with_no_change")
#: Of the objects, where a method tells them.
OBJECTS = (
    "regions", "recall", "recall_interval", "objects", "precision", "precision_interval", "false_objects",
    "false_objects_a_quiet_visit", "quiet_visits_with_an_object", "moved", "told_as_moved",
)  # fmt: skip


#: Of the things that were put into real scans.
REAL = ("pairs", "things", "found", "recall", "objects", "precision", "false_objects_a_pair")
#: Of the time that a map's tiles take.
SPEED = ("precision", "tiles", "seconds", "processor_seconds", "times_c2c", "times_c2c_of_processor")


def record_figures(model_store: Path, model: str, files: Mapping[str, Path]) -> Path:
    """Put the benchmarks' `files`, by the names of SECTIONS, on the model's card; returns the card.

    What else stands in its evaluation is kept. Raises DetectorUnavailable, OSError, and ValueError for a file that is
    no such benchmark's, or was made with other weights.
    """
    card = open_card(model_store, model)
    sections = dict(_section(name, path, card) for name, path in files.items())
    folder = model_store / model
    write_card(folder, card.model_copy(update={"evaluation": {**card.evaluation, **sections}}))
    return folder / "card.json"


def outdated_sections(card: Card) -> list[str]:
    """Name the benchmarks on this card that were measured with other weights, or settings, than its own."""
    names = (*SECTIONS, ON_GPU)
    measured = {name: card.evaluation[name] for name in names if name in card.evaluation}
    return [name for name, section in measured.items() if not _is_of(section, card)]


def _is_of(section: Figures, card: Card) -> bool:
    """Tell whether a section is of the card's weights; those of older releases say nothing of the settings."""
    fingerprint = section.get("fingerprint", card.fingerprint)
    return bool(section.get("sha256") == card.sha256 and fingerprint == card.fingerprint)


def paper_figures(document: Figures, card: Card) -> Figures:
    """Return the figures of `evaluate paper`, JSON-ready.

    They are at the threshold that was chosen on another corridor, unless the name says otherwise. Raises
    KeyError, and ValueError for other weights or a part of the experiments.
    """
    _require_same(document, card)
    ours, *baselines = document["table_6"]
    *experiments, whole = document["table_5"]
    if whole["paper"] is None:
        raise ValueError("measured on a part of the experiments; leave out --quick")
    settings = document["settings"]
    data = {
        "corridor": settings["seed"],
        "validation_corridor": settings["validation_seed"],
        "experiments": len(experiments),
        "everywhere": settings["everywhere"],
    }
    return {
        **_head(document, card, data),
        "tiles": document["map"]["tiles"],
        **_operating(ours),
        **_picked(ours, AREAS),
        "at_test_threshold": _operating(ours["at_test_threshold"], ours["test_threshold"]),
        "false_positives_with_no_change": _quiet(experiments),
        "removals": _removals(experiments),
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
                **_picked(row, tuple(name for name in LATER if name in row)),
            }
            for row in baselines
        },
    }


def revisit_figures(document: Figures, card: Card) -> Figures:
    """Return the figures of `evaluate revisit`, JSON-ready.

    They are at the threshold that was chosen on other buildings, unless the name says otherwise. Raises KeyError,
    and ValueError where no method was this model.
    """
    ours = [row for row in document["methods"] if _measured_as(row) == (card.sha256, card.fingerprint)]
    if not ours:
        measured = [str(row["sha256"] or row["name"]) for row in document["methods"]]
        raise ValueError(
            f"measured with weights {', '.join(measured)}, and not with the card's {card.fingerprint}"
        )
    test = document["test"]
    data = {
        "seeds": document["seeds"],
        "visits": test["visits"],
        "validation_visits": document["validation"]["visits"],
    }
    return {
        **_head(document, card, data),
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


def real_figures(document: Figures, card: Card) -> Figures:
    """Return the figures of `evaluate real`, JSON-ready, at the card's own threshold.

    Raises KeyError, and ValueError where no model was this one, or not all places were taken.
    """
    ours = _own(document["edited"]["models"], card)
    if not document["data"]["whole"]:
        raise ValueError("measured on a part of the places; leave out --place")
    same = [pair for pair in document["pairs"] if pair["same_scans"]]
    told = [answer for pair in same for answer in pair["answers"] if answer["model"] == card.model]
    return {
        **_head(document, card, document["data"]),
        **_picked(ours, REAL),
        "tiles": ours["tiles"],
        "tiles_changed_between_equal_scans": sum(one["tiles"]["changed"] for one in told),
        "tiles_of_equal_scans": sum(one["tiles"]["changed"] + one["tiles"]["unchanged"] for one in told),
    }


def speed_figures(document: Figures, card: Card) -> Figures:
    """Return the figures of `evaluate speed`, JSON-ready. Raises KeyError, ValueError where no model was this one."""
    ours = _own(document["methods"], card)
    return {
        **_head(document, card, document["data"]),
        "machine": document["machine"],
        **_picked(ours, SPEED),
        "baselines": {
            row["model"]: _picked(row, SPEED) for row in document["methods"] if row["fingerprint"] is None
        },
    }


SECTIONS: dict[str, Callable[[Figures, Card], Figures]] = {
    "paper": paper_figures,
    "revisit": revisit_figures,
    "real": real_figures,
    "speed": speed_figures,
}
ON_GPU = "speed_on_gpu"  #: the section of a speed that was measured on a GPU; it stands beside `speed`


def _section(name: str, path: Path, card: Card) -> tuple[str, Figures]:
    """Return what a file says of the card's model, with the name that it has there."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        section = SECTIONS[name](document, card)
    except (KeyError, IndexError, TypeError, AttributeError) as missing:
        raise ValueError(f"{path} is no result of `spicd-worker evaluate {name}`: {missing!r}") from missing
    except ValueError as other:
        raise ValueError(f"{path}: {other}") from other
    on_gpu = name == "speed" and section["machine"]["device"] != "cpu"
    return (ON_GPU if on_gpu else name), section


def _head(document: Figures, card: Card, data: Figures) -> Figures:
    return {
        "command": document["command"],
        "sha256": card.sha256,
        "fingerprint": card.fingerprint,
        "data": data,
    }


def _measured_as(row: Figures) -> tuple[str | None, str | None]:
    """Return what tells whose figures these are; files of release 0.3 and before name weights alone."""
    return row["sha256"], row.get("fingerprint", row["sha256"])


def _require_same(row: Figures, card: Card) -> None:
    if _measured_as(row) != (card.sha256, card.fingerprint):
        raise ValueError(
            f"measured with weights {_measured_as(row)[1]}, and not with the card's {card.fingerprint}"
        )


def _own(rows: list[Figures], card: Card) -> Figures:
    """Return the row of the card's model. Raises ValueError where there is none, or of other weights."""
    ours = [row for row in rows if row["model"] == card.model]
    if not ours:
        raise ValueError(f"measured {', '.join(str(row['model']) for row in rows)}, and not {card.model}")
    _require_same(ours[0], card)
    return ours[0]


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


def _removals(experiments: list[Figures]) -> Figures:
    """Return the figures of the one experiment that removes."""
    return _picked(next(row for row in experiments if row["operation"] == "remove"), REMOVALS)


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
