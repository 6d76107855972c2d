"""`spicd up`: the whole service as one command."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from service.cli.settings import read_settings
from service.cli.terminal import Terminal
from service.up.embedded_redis import LaunchFailed

if TYPE_CHECKING:
    from service.up.launcher import Running


def up(
    ctx: typer.Context,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port; 0 takes a free one.")] = None,
    root_path: Annotated[
        str | None, typer.Option("--root-path", help="Path that something in front has the API under.")
    ] = None,
    data_dir: Annotated[Path | None, typer.Option("--data-dir", help="Everything that is kept.")] = None,
    geometry_workers: Annotated[int | None, typer.Option("--geometry-workers")] = None,
    inference_workers: Annotated[int | None, typer.Option("--inference-workers")] = None,
    ready_file: Annotated[
        Path | None, typer.Option("--ready-file", help="JSON with address and process ids, once it is up.")
    ] = None,
    end_with_parent: Annotated[
        bool, typer.Option("--end-with-parent", help="End when the starting process ends, however it does.")
    ] = False,
) -> None:
    """Start API, workers and Redis, and stay; Ctrl-C ends all. What is left out comes from SPICD_* or defaults."""
    # The API and uvicorn are of no use to the other commands, which start the faster without.
    from service.logs import set_up_logging  # noqa: PLC0415
    from service.up.launcher import up as launch  # noqa: PLC0415
    from service.up.lifetime import end_with_parent as end  # noqa: PLC0415

    if end_with_parent:
        end(os.getppid())
    terminal: Terminal = ctx.obj
    settings = read_settings(
        host=host,
        port=port,
        root_path=root_path,
        data_dir=data_dir,
        geometry_workers=geometry_workers,
        inference_workers=inference_workers,
    )
    set_up_logging(settings.log_level, settings.log_format)

    def ready(running: Running) -> None:
        if ready_file is not None:
            _write_ready_file(running, ready_file)
        if terminal.as_json:
            sys.stdout.write(
                json.dumps(running.document()) + "\n"
            )  # one line: who reads it does not wait for more
            sys.stdout.flush()
        else:
            terminal.out.print(_table(running.document()))

    launch(settings, on_ready=ready)


def _write_ready_file(running: Running, path: Path) -> None:
    try:
        running.write(path)
    except OSError as error:
        raise LaunchFailed(f"the ready file {path} cannot be written ({error.strerror})") from error


def _table(running: dict[str, Any]) -> Table:
    table = Table(title="SPICD is up", show_header=False, caption="Ctrl-C ends it")
    queues = [worker["queue"] for worker in running["workers"]]
    workers = ", ".join(f"{queues.count(queue)} {queue}" for queue in dict.fromkeys(queues))
    table.add_row("service", running["url"])
    table.add_row("documentation", running["docs"])
    table.add_row("data folder", running["data_dir"])
    table.add_row("workers", workers or "none: jobs wait")
    return table
