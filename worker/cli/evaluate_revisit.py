"""`spicd-worker evaluate revisit`: two visits of one building, and who finds what changed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from worker.cli import terminal
from worker.cli.command_line import as_given
from worker.detectors.card import MODEL_STORE


def register(group: typer.Typer) -> None:
    """Add the command to the group `evaluate`."""
    group.command("revisit")(revisit)


def revisit(
    context: typer.Context,
    visits: Annotated[
        int, typer.Option(min=1, help="Second visits; every three go to a building of their own.")
    ] = 24,
    validation: Annotated[
        int, typer.Option(min=1, help="Visits to other buildings, on which thresholds are chosen.")
    ] = 12,
    model: Annotated[str, typer.Option(envvar="SPICD_MODEL", help="name/version")] = "spicd-net/1",
    model_store: Annotated[
        Path, typer.Option("--model-store", envvar="SPICD_MODEL_STORE", help="Folder of the models.")
    ] = MODEL_STORE,
    weights: Annotated[
        list[Path] | None,
        typer.Option(help="Checkpoint of `train`, instead of the model's weights; may be given again."),
    ] = None,
    buildings: Annotated[
        str, typer.Option(help="Of room, office, corridor, loop, with commas; taken in turn.")
    ] = "room,office,corridor,loop",
    out: Annotated[
        Path, typer.Option(help="Folder for revisit.json, pictures, and the visits, which are kept.")
    ] = Path("bench/revisit"),
    as_json: Annotated[bool, typer.Option("--json", help="Figures as JSON on stdout.")] = False,
) -> None:
    """Two independent visits, whole objects added, removed, moved between them: the model and what else there is.

    Simulating and registering the visits takes minutes and is done once: another model on the same visits takes one.
    """
    # Not at the head of the file: torch, Open3D and Matplotlib take seconds, which `--help` need not wait for.
    from worker.benchmarks.revisit.benchmark import BenchmarkSettings, evaluate  # noqa: PLC0415
    from worker.benchmarks.revisit.plan import RevisitSettings, kinds_named  # noqa: PLC0415
    from worker.benchmarks.revisit.tables import tables  # noqa: PLC0415

    settings = BenchmarkSettings(
        out=out,
        visits=visits,
        validation=validation,
        model=model,
        model_store=model_store,
        weights=tuple(weights or ()),
        made=RevisitSettings(kinds=kinds_named(buildings)),
    )
    with terminal.progress_bar() as progress:
        result = {"command": as_given(context), **evaluate(settings, progress)}
    aside = out / "revisit.json.tmp"
    aside.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    aside.replace(out / "revisit.json")
    if as_json:
        terminal.print_json(result)
        return
    terminal.output().print(tables(result), highlight=False)
    terminal.output().print(f"saved in {out}", highlight=False)
