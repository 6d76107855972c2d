"""`spicd-worker evaluate paper`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from worker.cli import terminal
from worker.cli.command_line import as_given
from worker.detectors.card import MODEL_STORE


def register(group: typer.Typer) -> None:
    """Add `paper` to the group of benchmarks."""
    group.command("paper")(paper)


def paper(
    context: typer.Context,
    model: Annotated[str, typer.Option(envvar="SPICD_MODEL", help="name/version")] = "spicd-net/1",
    model_store: Annotated[
        Path, typer.Option("--model-store", envvar="SPICD_MODEL_STORE", help="Folder of the models.")
    ] = MODEL_STORE,
    weights: Annotated[
        Path | None, typer.Option(help="Checkpoint of training to measure, under the model's card.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the corridor and the walk.")] = 1,
    validation_seed: Annotated[
        int, typer.Option(help="Of the corridor that thresholds are chosen on.")
    ] = 101,
    true_poses: Annotated[
        bool, typer.Option("--true-poses", help="Scans stand where they were taken; no registration.")
    ] = False,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="Changes are in all scans of a tile, not in one alone.")
    ] = False,
    robustness: Annotated[
        bool, typer.Option(help="Also disturb one experiment of each kind, level by level.")
    ] = True,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Three experiments on a short corridor: whether it runs, no figures to cite."
        ),
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for report.html, paper.json and pictures.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Figures as JSON on stdout.")] = False,
) -> None:
    """Repeat the fourteen experiments of the paper on a simulated corridor, its figures beside ours."""
    # Not at the head of the file: torch, Open3D and Matplotlib take seconds, which `--help` need not wait for.
    from worker.benchmarks.paper.benchmark import QUICK, PaperSettings, evaluate  # noqa: PLC0415
    from worker.benchmarks.paper.document import document  # noqa: PLC0415
    from worker.benchmarks.paper.report import write_report  # noqa: PLC0415
    from worker.benchmarks.paper.site import QUICK_SITE, SiteSettings  # noqa: PLC0415
    from worker.benchmarks.paper.tables import tables  # noqa: PLC0415

    settings = PaperSettings(
        site=replace(QUICK_SITE if quick else SiteSettings(), seed=seed, true_poses=true_poses),
        validation_seed=validation_seed,
        model=model,
        model_store=model_store,
        weights=weights,
        everywhere=everywhere,
        robustness=robustness,
        only=QUICK if quick else None,
    )
    with terminal.progress_bar() as progress:
        result = evaluate(settings, progress)
        told = {"command": as_given(context), **document(result)}
        written = None if out is None else write_report(result, told, out)
    if as_json:
        terminal.print_json(told)
        return
    terminal.output().print(tables(told), highlight=False)
    if written is not None:
        terminal.output().print(f"report: {written}", highlight=False)
