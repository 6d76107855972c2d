"""`spicd-worker evaluate record`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from worker.cli import terminal
from worker.detectors.card import MODEL_STORE


def register(group: typer.Typer) -> None:
    """Add `record` to the group of benchmarks."""
    group.command("record")(record)


def record(
    paper: Annotated[Path | None, typer.Option(help="paper.json of `evaluate paper`.")] = None,
    revisit: Annotated[Path | None, typer.Option(help="revisit.json of `evaluate revisit`.")] = None,
    model: Annotated[str, typer.Option(envvar="SPICD_MODEL", help="name/version")] = "spicd-net/1",
    model_store: Annotated[
        Path, typer.Option("--model-store", envvar="SPICD_MODEL_STORE", help="Folder of the models.")
    ] = MODEL_STORE,
) -> None:
    """Put the figures of the benchmarks on a model's card; refused where they were measured with other weights."""
    # Not at the head of the file: torch takes seconds, which `--help` need not wait for.
    from worker.benchmarks.card_figures import record_figures  # noqa: PLC0415

    given = {name: path for name, path in (("paper", paper), ("revisit", revisit)) if path is not None}
    if not given:
        raise ValueError("nothing to record: give --paper, --revisit, or both")
    path = record_figures(model_store, model, given)
    terminal.output().print(f"{path}: {', '.join(given)}", highlight=False)
