"""The figures of `spicd-worker evaluate real`, as tables on a terminal and as a page in Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.console import Group
from rich.table import Table

from worker.benchmarks.documents import Document, shown, titled_table, write_bytes, write_json
from worker.benchmarks.real.pictures import file_name

Rows = list[list[str]]  #: the columns' names first

PAGE = "real.md"


def tables(result: Document) -> Group:
    """Show what each model says of each pair, and what it finds of things put in."""
    return Group(
        _table("Real pairs as they are: objects (voxels); changed of observed tiles", _pairs(result)),
        *([] if result["registered"] is None else [_table("With our own registration", _registered(result))]),
        _table(_edited_title(result), _edited(result)),
        *(_table("Things found, by group", groups) for groups in _told_groups(result)),
    )


def write_report(result: Document, folder: Path) -> Path:
    """Write `real.json` and `real.md`, which shows the pictures beside it; returns the page. Raises OSError."""
    write_json(folder / "real.json", result)
    write_bytes(folder / PAGE, page(result, folder).encode())
    return folder / PAGE


def page(result: Document, folder: Path) -> str:
    """Return the page, with the pictures that lie in the folder."""
    parts = ["# Real scans", "## As they are", _markdown(_pairs(result))]
    if result["registered"] is not None:
        parts += ["## With the product's own registration", _markdown(_registered(result))]
    parts += [
        "## With things put in",
        _edited_title(result),
        _markdown(_edited(result)),
        *map(_markdown, _told_groups(result)),
    ]
    parts.append("## Pictures")
    for name in (
        *(pair["name"] for pair in result["pairs"]),
        *(f"edited {pair['name']}" for pair in result["edited"]["pairs"]),
    ):
        for ending in ("", "-objects"):
            file = f"{file_name(name)}{ending}.png"
            if (folder / file).exists():
                parts.append(f"![{name}]({file})")
    return "\n\n".join(parts) + "\n"


def _pairs(result: Document) -> Rows:
    rows = [["map to survey", *result["models"]]]
    return rows + [[pair["name"], *(_answer(one) for one in pair["answers"])] for pair in result["pairs"]]


def _answer(answer: Document) -> str:
    """Write as in `1 moved (47+81), 1 appeared (20); 3 of 14 tiles; 76% judged`."""
    tiles = answer["tiles"]
    words = f"{tiles['changed']} of {tiles['changed'] + tiles['unchanged']} tiles"
    if answer["objects"] is None:
        return words
    judged = answer["voxels_judged"] / max(answer["voxels"], 1)
    return f"{_objects(answer['objects'])}; {words}; {judged:.0%} judged"


def _objects(objects: Sequence[Document]) -> str:
    if not objects:
        return "nothing"
    kinds = Counter(one["kind"] for one in objects)
    parts = []
    for kind, count in kinds.items():
        sizes = [
            "+".join(str(size) for size in one["voxels"] if size) for one in objects if one["kind"] == kind
        ]
        parts.append(f"{count} {kind} ({', '.join(sizes)})")
    return ", ".join(parts)


def _registered(result: Document) -> Rows:
    rows = [["map to survey", "off the given pose", *result["models"]]]
    for pair in result["registered"]:
        if "reason" in pair:
            rows.append([pair["name"], pair["reason"], *("" for _ in result["models"])])
            continue
        off = f"{shown(pair['centimetres_off'], '.1f', unit=' cm')}, {shown(pair['degrees_off'], '.2f', unit=' degrees')}"
        off += f", without {', '.join(pair['left_out'])}" if pair["left_out"] else ""
        rows.append([pair["name"], off, *(_answer(one) for one in pair["answers"])])
    return rows


def _edited_title(result: Document) -> str:
    edited = result["edited"]
    models = edited["models"]
    things = models[0]["things"] if models else 0
    return (
        f"{len(edited['pairs'])} real pairs with things put into one visit: {things} things of at least 40 voxels that "
        "the other visit's rays decide"
    )


def _edited(result: Document) -> Rows:
    rows = [
        ["model", "things found", "recall", "objects", "precision", "new false objects a pair", "of 20 voxels or more",
         "tile F1", "precision", "recall"],
    ]  # fmt: skip
    for model in result["edited"]["models"]:
        for name, figures in ((model["model"], model), ("  with free space", model["with_free_space"])):
            tiles = figures["tiles"]
            rows.append(
                [
                    name,
                    "-" if figures["found"] is None else f"{figures['found']} of {figures['things']}",
                    shown(figures["recall"], ".2f", missing="-"),
                    shown(figures["objects"], "d", missing="-"),
                    shown(figures["precision"], ".2f", missing="-"),
                    shown(figures["false_objects_a_pair"], ".2f", missing="-"),
                    shown(figures["false_objects_of_any_size_a_pair"], ".2f", missing="-"),
                    *(shown(tiles[key], ".2f", missing="-") for key in ("f1", "precision", "recall")),
                ]
            )
    return rows


def _told_groups(result: Document) -> list[Rows]:
    """Return the table of things by group; none where no model tells things."""
    rows = _groups(result)
    return [rows] if len(rows) > 1 else []


def _groups(result: Document) -> Rows:
    models = [model for model in result["edited"]["models"] if model["found"] is not None]
    rows = [["things", *(model["model"] for model in models)]]
    for by, names in (models[0]["groups"] if models else {}).items():
        for name in names:
            cells = [model["groups"][by].get(name, [0, 0]) for model in models]
            rows.append([name, *(f"{yes} of {of}" for yes, of in cells)])
    return rows


def _table(title: str, rows: Rows) -> Table:
    return titled_table(title, rows[0], rows[1:])


def _markdown(rows: Rows) -> str:
    lines = [f"| {' | '.join(cell.strip() for cell in row)} |" for row in rows]
    return "\n".join([lines[0], f"|{' --- |' * len(rows[0])}", *lines[1:]])
