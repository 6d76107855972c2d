"""`spicd events`: what happens, as it happens."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from service.cli.completion import maps
from service.cli.terminal import Terminal
from service.client import Event


def follow(
    ctx: typer.Context,
    event_type: Annotated[
        list[str] | None, typer.Option("--type", help="Such as survey.ready; repeat it; left out: all.")
    ] = None,
    map_id: Annotated[
        str | None, typer.Option("--map", help="Of this map only.", autocompletion=maps)
    ] = None,
    after: Annotated[
        str | None,
        typer.Option(help="Number of the last event seen, 0: from the first; left out: from now on."),
    ] = None,
) -> None:
    """A line for each event, until Ctrl-C; with --json a document a line."""
    terminal: Terminal = ctx.obj
    try:
        with terminal.client() as client:
            for event in client.events(types=event_type or (), map_id=map_id, after=after):
                terminal.line(json.dumps(event) if terminal.as_json else _line(event))
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def _line(event: Event) -> str:
    return f"{event.get('sequence', '')}  {event['time']}  {event['type']}  {event.get('subject', '')}"
