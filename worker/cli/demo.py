"""`spicd-worker demo`, which is `make demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from worker.cli import terminal


def demo(
    out: Annotated[Path, typer.Option(help="Folder for scans, results and the service's data.")] = Path(
        "demo"
    ),
    model: Annotated[
        str | None, typer.Option(help="Model, name/version; left out: the service's own choice.")
    ] = None,
    look: Annotated[
        bool,
        typer.Option(
            "--look", help="On a terminal, keep the service with its viewer on the result until Ctrl-C."
        ),
    ] = False,
    seed: Annotated[int, typer.Option(help="Of the noise and of the robot's way.")] = 1,
) -> None:
    """Simulate two visits to a small building, run the whole service on them, and show what it found."""
    # Not at the head of the file: Open3D takes a second, which `--help` need not wait for.
    from worker.demo.run import run  # noqa: PLC0415
    from worker.demo.story import DemoSettings  # noqa: PLC0415

    run(
        out,
        DemoSettings(seed=seed, model=model),
        out_console=terminal.output(),
        err_console=terminal.messages(),
        look=look and terminal.is_attended(),
    )
