"""`spicd-worker evaluate table`: all detectors side by side, from what their cards say, and the paper's figures beside.

What a card lacks is said to be not measured. Nothing is measured here.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from safetensors import safe_open

from worker.benchmarks.card_figures import ON_GPU, SECTIONS, outdated_sections
from worker.benchmarks.paper.experiments import published
from worker.detectors.card import BaseRecord, Card
from worker.detectors.store import open_card
from worker.files import write_text

BEGIN, END = "<!-- evaluate table: begin -->", "<!-- evaluate table: end -->"
MISSING = "not measured"
NOT_PRINTED = "not in the paper"
NONE = "none"
#: The detectors in the table's order; others come after them by name.
ORDER = (
    "spicd-net",
    "pointnet2",
    "kpconv",
    "c2c",
    "C2C (mean)",
    "M3C2-approx",
    "M3C2",
    "voxel-rule",
    "voxel-net",
)
#: Methods without a card: their figures stand beside those of the models that they were measured with.
BASELINES = ("C2C (mean)", "M3C2-approx", "M3C2")
#: What the paper's Table 6 calls a family.
PRINTED = {
    "spicd-net": "SPICD-Net",
    "pointnet2": "Siamese-PointNet++",
    "kpconv": "Siamese-KPConv",
    "c2c": "C2C",
    "C2C (mean)": "C2C",
    "M3C2-approx": "M3C2-approx",
}
#: Of a network's tensors, what is no parameter.
STATISTICS = ("running_mean", "running_var", "num_batches_tracked", "encoder.kernel")

ALL_VISITS = 48  #: of `evaluate revisit`; figures of fewer are marked

Section = dict[str, Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class Measured:
    """What is known of a method: its figures by benchmark, and what it is made of."""

    name: str
    sections: Mapping[str, Section]
    beside: Mapping[str, str]  #: of a method without a card: whose card each section was taken from
    sha256: str | None = None  #: of its weights
    parameters: int | None = None
    training_seconds: float | None = None
    trained: bool = False  #: whether it has anything to train


def write_table(page: Path, model_store: Path, *, check: bool = False) -> bool:
    """Write the table between the page's markers; tells whether it was another one. With `check` nothing is written.

    Raises ValueError where there are no markers, where figures are of other weights, and with `check` where the page
    is not what the cards say; OSError for the page; DetectorUnavailable for an unsound card.
    """
    text = page.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{page} has no place for the table: {BEGIN} and {END}")
    fresh = f"{before}{BEGIN}\n\n{markdown(measured(model_store))}\n{END}{after}"
    if fresh != text:
        if check:
            raise ValueError(f"{page} is not what the cards say; run `spicd-worker evaluate table`")
        write_text(page, fresh)
    return fresh != text


def measured(model_store: Path) -> list[Measured]:
    """Read every card of the store, and the methods without one, in the table's order.

    Raises DetectorUnavailable, and ValueError for figures that were measured with other weights.
    """
    names = sorted("/".join(card.parts[-3:-1]) for card in model_store.glob("*/*/card.json"))
    cards = {name: open_card(model_store, name) for name in names}
    rows = [_of_card(card, model_store) for card in cards.values()]
    rows += [_of_baseline(name, cards) for name in BASELINES]
    return sorted(rows, key=lambda row: (_place(row.name), row.name))


def _place(name: str) -> int:
    family = name.partition("/")[0]
    return ORDER.index(family) if family in ORDER else len(ORDER)


def _of_card(card: Card, model_store: Path) -> Measured:
    outdated = outdated_sections(card)
    if outdated:
        raise ValueError(f"{card.model}: {', '.join(outdated)} measured with other weights than the card's")
    return Measured(
        name=card.model,
        sections={name: card.evaluation[name] for name in (*SECTIONS, ON_GPU) if name in card.evaluation},
        beside={},
        sha256=card.sha256,
        parameters=sum(parameters_of(card, model_store).values()) or None,
        training_seconds=training_seconds(card, model_store),
        trained=card.weights is not None,
    )


def _of_baseline(name: str, cards: Mapping[str, Card]) -> Measured:
    """Gather what the first card, in the table's order, says of a method that it was measured beside."""
    sections: dict[str, Section] = {}
    beside: dict[str, str] = {}
    for model in sorted(cards, key=lambda model: (_place(model), model)):
        for section in (*SECTIONS, ON_GPU):
            told = cards[model].evaluation.get(section, {})
            if section not in sections and name in told.get("baselines", {}):
                head = {key: told[key] for key in ("command", "data", "machine", "visits") if key in told}
                sections[section] = head | told["baselines"][name]
                beside[section] = model
    return Measured(name=name, sections=sections, beside=beside)


def parameters_of(card: Card, model_store: Path) -> dict[str, int]:
    """Count what was learned, by tensor: the numbers in a model's weights, less the statistics that it normalises by.

    A model of which a part was trained has the other tensors of its base. Raises ValueError for weights that are not
    those of the card, or of a base that the card does not name.
    """
    known = {} if card.base is None else parameters_of(_base(card, card.base, model_store), model_store)
    if card.weights is None:
        return known
    weights = model_store / card.model / card.weights
    if hashlib.sha256(weights.read_bytes()).hexdigest() != card.sha256:
        raise ValueError(f"{weights} are not the weights that the card of {card.model} names")
    with safe_open(weights, framework="numpy") as tensors:
        names = [name for name in tensors.keys() if not name.endswith(STATISTICS)]  # noqa: SIM118 (no dict)
        return known | {name: prod(tensors.get_slice(name).get_shape()) for name in names}


def _base(card: Card, record: BaseRecord, model_store: Path) -> Card:
    base = open_card(model_store, record.model)
    if base.sha256 != record.sha256:
        raise ValueError(f"{card.model} is a part of {base.model} with other weights")
    return base


def training_seconds(card: Card, model_store: Path) -> float | None:
    """Return how long the training took, that of a base included.

    It is what the card says in all, or else the last rows of the logs beside it and what the head took, added up.
    """
    if "seconds_in_all" in card.training:
        return float(card.training["seconds_in_all"])
    before = 0.0 if card.base is None else training_seconds(_base(card, card.base, model_store), model_store)
    ends = [_last_second(log) for log in sorted((model_store / card.model).glob("epochs*.csv"))]
    head = card.training.get("head_alone", {}).get("seconds")
    known = [float(end) for end in (*ends, head) if end is not None]
    return None if before is None or not known else before + sum(known)


def _last_second(log: Path) -> float | None:
    with log.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return float(rows[-1]["seconds"]) if rows else None


def _number(row: Measured, section: str, *path: str, digits: int = 2) -> str | None:
    """Write the figure at a path of a section; None where there is none."""
    value: Any = row.sections.get(section)
    for name in path:
        value = None if value is None else value.get(name)
    return None if value is None else f"{value:.{digits}f}"


def _paper_f1(row: Measured) -> str | None:
    """Write the F1 at the threshold chosen elsewhere, and in brackets at the best one on the experiments themselves."""
    section = row.sections.get("paper")
    if section is None:
        return None
    best = section.get("f1_at_test_threshold", section.get("at_test_threshold", {}).get("f1"))
    return f"{_ratio(section['f1'])} ({_ratio(best)})"


def _paper_says(row: Measured) -> str:
    """Write what the paper prints of a family: F1 (Table 6), of its own network removals (Table 5), and seconds."""
    family = row.name.partition("/")[0]
    if family not in PRINTED:
        return NOT_PRINTED
    told = published()["table_6"][PRINTED[family]]
    removals = published()["table_5"]["type_remove"]["f1"]
    own = f", removals {removals:.2f}" if family == "spicd-net" else ""
    return f"{told['f1']:.3f}{own}; {told['seconds']:.1f} s"


def _ratio(value: float | None) -> str:
    return "none" if value is None else f"{value:.2f}"


def _visits_f1(row: Measured) -> str | None:
    """Write the F1 over tiles, and how many visits it is of where these are not all."""
    section = row.sections.get("revisit")
    if section is None:
        return None
    few = "" if section["visits"] == ALL_VISITS else f" (of {section['visits']} visits alone)"
    return f"{section['f1']:.3f}{few}"


def _removals(row: Measured) -> str | None:
    """Write both; of a card that has the F1 alone, that."""
    section = row.sections.get("paper", {})
    told = section.get("removals")
    if told is not None:
        return f"{_ratio(told['f1'])}, {_ratio(told['recall'])}"
    alone = section.get("f1_by_experiment", {}).get("type_remove")
    return None if alone is None else f"{_ratio(alone)}, {MISSING}"


def _quiet_alarms(row: Measured) -> str | None:
    told = row.sections.get("paper", {}).get("false_positives_with_no_change")
    return None if told is None else str(told["validation_threshold"])


def _quiet_visits(row: Measured) -> str | None:
    section = row.sections.get("revisit")
    if section is None:
        return None
    return f"{section['quiet_visits_with_false_tile']} of {section['quiet_visits']}"


def _objects(row: Measured) -> str | None:
    section = row.sections.get("revisit")
    if section is None:
        return None
    told = section["objects"]
    return "tells none" if told is None else f"{told['recall']:.2f}, {told['precision']:.2f}"


def _things(row: Measured) -> str | None:
    section = row.sections.get("real")
    if section is None:
        return None
    return "tells none" if section["found"] is None else f"{section['found']} of {section['things']}"


def _speed(row: Measured, section: str) -> str | None:
    told = row.sections.get(section)
    if told is None:
        return None
    tiles = "" if told["tiles"] == told["data"]["tiles"] else f" for {told['tiles']}"
    processor = f" ({told['processor_seconds']['median']:.1f} s of processor)" if section == "speed" else ""
    precision = told.get("precision") or "float32"
    coarse = "" if precision == "float32" else f", {precision}"
    return f"{told['seconds']['median']:.2f} s{tiles}{processor}{coarse}"


def _duration(seconds: float | None) -> str | None:
    if seconds is None:
        return None
    return f"{seconds / 60:.0f} min" if seconds < 2 * 3600 else f"{seconds / 3600:.1f} h"


#: What stands above each column, and how it is read; None: nobody measured it.
COLUMNS: tuple[tuple[str, Callable[[Measured], str | None]], ...] = (
    ("detector", lambda row: f"`{row.name}`" if "/" in row.name else row.name),
    ("weights", lambda row: f"`{row.sha256[:12]}`" if row.sha256 else NONE),
    ("fourteen experiments: F1", _paper_f1),
    ("removals: F1, recall", _removals),
    ("false alarms with nothing changed", _quiet_alarms),
    ("in the paper: F1; 172 tiles on a GTX 1650", _paper_says),
    ("second visits: tile F1", _visits_f1),
    ("AP", lambda row: _number(row, "revisit", "average_precision", digits=3)),
    ("quiet visits with a changed tile", _quiet_visits),
    ("objects: recall, precision", _objects),
    ("real scans: tile F1", lambda row: _number(row, "real", "tiles", "f1")),
    ("things found", _things),
    ("parameters", lambda row: f"{row.parameters:,}" if row.parameters else NONE),
    ("training", lambda row: _duration(row.training_seconds) if row.trained else NONE),
    ("172 tiles, two cores", lambda row: _speed(row, "speed")),
    ("172 tiles, GPU", lambda row: _speed(row, ON_GPU)),
)
SOURCES = ("detector", "figures", "command", "measured on", "weights (sha256)")


def markdown(rows: list[Measured]) -> str:
    """Return the table, and where every figure is from."""
    heads = [head for head, _ in COLUMNS]
    cells = [[read(row) or MISSING for _, read in COLUMNS] for row in rows]
    parts = [
        _lines(heads, cells),
        "Where these figures are from:",
        _lines(SOURCES, _sources(rows)),
    ]
    return "\n\n".join(parts) + "\n"


def _lines(heads: tuple[str, ...] | list[str], rows: list[list[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in (list(heads), *rows)]
    return "\n".join([lines[0], f"|{' --- |' * len(heads)}", *lines[1:]])


def _sources(rows: list[Measured]) -> list[list[str]]:
    lines = []
    for row in rows:
        for name, section in row.sections.items():
            beside = f", beside `{row.beside[name]}`" if name in row.beside else ""
            lines.append(
                [
                    COLUMNS[0][1](row) or "",
                    name.replace("_", " "),
                    f"`{section['command']}`{beside}",
                    _words(section.get("data") or {"visits": section.get("visits")}, section.get("machine")),
                    f"`{row.sha256}`" if row.sha256 else NONE,
                ]
            )
    return lines


def _words(data: Mapping[str, Any], machine: Mapping[str, Any] | None) -> str:
    parts = [f"{name.replace('_', ' ')} {_plain(value)}" for name, value in data.items() if value is not None]
    if machine is not None:
        device = machine["processor"] if machine["device"] == "cpu" else machine["device"]
        parts.append(f"{device}, {machine['cores_used']} threads, load {machine['load_before']} before")
    return "; ".join(parts)


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain(one)}" for name, one in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value[:12] if isinstance(value, str) else str(value)
