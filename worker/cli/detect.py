"""`spicd-worker detect`: what a survey does, on files and in this process."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.table import Table

from worker.cli import terminal
from worker.cli.options import DEFAULT_MODEL, AsJson, Device, Model, ModelStore
from worker.detectors.card import MODEL_STORE

MOST_ROWS = 20  #: changed tiles in the table; the file has all


def detect(
    reference: Annotated[Path, typer.Argument(help="PLY or PCD of the earlier visit; it sets the frame.")],
    current: Annotated[list[Path], typer.Argument(help="PLY or PCD files of the later visit.")],
    more: Annotated[
        list[Path] | None, typer.Option("--reference", help="One more file of the earlier visit; repeatable.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for tiles.geojson, cloud.ply and picture.png.")] = Path(
        "changes"
    ),
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
    """Show the scans, the changed tiles most certain first, and the files."""
    counts = ", ".join(f"{count} {state}" for state, count in result["counts"].items())
    changed = result["changed"]
    return Group(
        _scan_table(result),
        *([_tile_table(changed[:MOST_ROWS])] if changed else []),
        *([f"... and {len(changed) - MOST_ROWS} more changed tiles"] if len(changed) > MOST_ROWS else []),
        f"{counts}; changed is a score above {result['threshold']:.2f} ({result['model']})",
        *(f"{what:<8} {path}" for what, path in result["files"].items()),
    )


def _scan_table(result: dict[str, Any]) -> Table:
    table = Table("visit", "scan", "placed", "fitness", "RMSE (cm)", "why not")
    for visit in ("reference", "current"):
        for scan in result[visit]:
            fitness, rmse = scan["fitness"], scan["rmse"]
            table.add_row(
                visit,
                scan["name"],
                "yes" if scan["accepted"] else "no",
                "" if fitness is None else f"{fitness:.2f}",
                "" if rmse is None else f"{rmse * 100:.1f}",
                scan["reason"] or "",
            )
    return table


def _tile_table(tiles: list[dict[str, Any]]) -> Table:
    table = Table("changed tile", "score", "from (m)", "to (m)", "points before", "after")
    for tile in tiles:
        lower, upper = (", ".join(f"{value:.2f}" for value in tile[corner]) for corner in ("lower", "upper"))
        counts = (str(tile["n_reference"]), str(tile["n_current"]))
        table.add_row(tile["tile_id"], f"{tile['score']:.2f}", lower, upper, *counts)
    return table
