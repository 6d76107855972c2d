"""`spicd-worker detect`: what a survey does, on files and in this process."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.table import Table

from worker.cli import terminal
from worker.cli.options import DEFAULT_MODEL, AsJson, Device, Model, ModelStore
from worker.cli.scan_results import told_warnings
from worker.detectors.card import MODEL_STORE

MOST_ROWS = 20  #: objects, or changed tiles, in the table; the file has all


def detect(
    reference: Annotated[
        Path, typer.Argument(help="PLY, PCD, E57, LAS or LAZ of the earlier visit; it sets the frame.")
    ],
    current: Annotated[list[Path], typer.Argument(help="Files of the later visit.")],
    more: Annotated[
        list[Path] | None, typer.Option("--reference", help="One more file of the earlier visit; repeatable.")
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder for objects.geojson, tiles.geojson, cloud.ply and picture.png.")
    ] = Path("changes"),
    model: Model = DEFAULT_MODEL,
    model_store: ModelStore = MODEL_STORE,
    threshold: Annotated[
        float | None, typer.Option(min=0, max=1, help="Probability of change; left out: the model's own.")
    ] = None,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Say what changed between the earlier and the later files, with no service at all."""
    # Not at the head of the file: torch, Open3D and Matplotlib take seconds, which `--help` need not wait for.
    from worker.cli.compare import compare, document, write_results  # noqa: PLC0415
    from worker.detectors.store import open_detector  # noqa: PLC0415

    with terminal.progress_bar() as progress:
        detector = open_detector(model_store, model, device)
        visits = compare(
            [reference, *(more or [])], current, detector, threshold=threshold, progress=progress
        )
        progress("writing", 0.0)
        files = write_results(visits, out, map_id=reference.name, survey_id=current[0].name, model=model)
    terminal.show(document(visits, files, model=model), summary, as_json=as_json)


def summary(result: dict[str, Any]) -> Group:
    """Show the scans, the objects or else the changed tiles, largest or most certain first, and the files."""
    counts = ", ".join(f"{count} {state}" for state, count in result["counts"].items())
    return Group(
        _scan_table(result),
        _placement(result["placement"]),
        *(_tiles(result["changed"]) if result["objects"] is None else _objects(result)),
        f"{counts}; changed is a score above {result['threshold']:.2f} ({result['model']})",
        *(f"{what:<8} {path}" for what, path in result["files"].items()),
    )


def _placement(placement: dict[str, Any]) -> str:
    if placement["confidence"] is None:
        return "placement by surfaces alone: it is not known from where the points were seen"
    confidence = f"(confidence {placement['confidence']:.2f})"
    if placement["state"] == "in_doubt":
        return f"placement in doubt {confidence}: no tile counts as unchanged or changed"
    return f"placement {placement['state']} {confidence}"


def _objects(result: dict[str, Any]) -> list[Table | str]:
    objects, moving = result["objects"], result["moving"]
    counts = Counter(thing["kind"] for thing in objects)
    told = ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no object changed"
    meanwhile = f"; {moving} more moved during a visit" if moving else ""
    return [*_shortened(objects, _object_table, "objects"), f"{told}{meanwhile}"]


def _tiles(changed: list[dict[str, Any]]) -> list[Table | str]:
    return _shortened(changed, _tile_table, "changed tiles")


def _shortened(
    rows: list[dict[str, Any]], table: Callable[[list[dict[str, Any]]], Table], noun: str
) -> list[Table | str]:
    """Return a table of the first rows, and how many more there are."""
    shown: list[Table | str] = [table(rows[:MOST_ROWS])] if rows else []
    return [*shown, f"... and {len(rows) - MOST_ROWS} more {noun}"] if len(rows) > MOST_ROWS else shown


def _scan_table(result: dict[str, Any]) -> Table:
    table = Table("visit", "scan", "placed", "fitness", "RMSE (cm)", "reason", "detail, warnings")
    for visit in ("reference", "current"):
        for scan in result[visit]:
            fitness, rmse = scan["fitness"], scan["rmse"]
            table.add_row(
                visit,
                scan["name"],
                "yes" if scan["accepted"] else "no",
                "" if fitness is None else f"{fitness:.2f}",
                "" if rmse is None else f"{rmse * 100:.1f}",
                (scan["reason"] or "").replace("_", " "),
                "\n".join(filter(None, [scan["detail"], told_warnings(scan["warnings"])])),
            )
    return table


def _object_table(objects: list[dict[str, Any]]) -> Table:
    table = Table("object", "kind", "center (m)", "size (m)", "over the floor (m)", "moved by", "probability")
    for thing in objects:
        place = thing["now"] or thing["before"]
        center, size = (", ".join(f"{value:.2f}" for value in place[name]) for name in ("center", "size"))
        height = place["height_over_floor"]
        table.add_row(
            str(thing["number"]),
            thing["kind"],
            center,
            size,
            "" if height is None else f"{height:.2f}",
            _moved_by(thing["motion"]),
            f"{thing['probability']:.2f}",
        )
    return table


def _moved_by(motion: dict[str, Any] | None) -> str:
    if motion is None:
        return ""
    shift = f"{math.hypot(*motion['translation']):.2f} m"
    return shift if motion["yaw"] is None else f"{shift}, {math.degrees(motion['yaw']):.0f}°"


def _tile_table(tiles: list[dict[str, Any]]) -> Table:
    table = Table("changed tile", "score", "from (m)", "to (m)", "points before", "after")
    for tile in tiles:
        lower, upper = (", ".join(f"{value:.2f}" for value in tile[corner]) for corner in ("lower", "upper"))
        counts = (str(tile["n_reference"]), str(tile["n_current"]))
        table.add_row(tile["tile_id"], f"{tile['score']:.2f}", lower, upper, *counts)
    return table
