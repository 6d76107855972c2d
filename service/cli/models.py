"""`spicd models`: what can score tiles, and a model of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table

from service.cli.completion import MapId
from service.cli.tables import columns, facts, number
from service.cli.terminal import Terminal, Wait
from service.client import Document


def list_(ctx: typer.Context) -> None:
    """The models that can score tiles, those of the site among them."""
    if ctx.invoked_subcommand is not None:
        return
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.models(), _table)


def train(
    ctx: typer.Context,
    map_id: MapId,
    name: Annotated[str | None, typer.Option(help="Left out: the map's id and `-net`.")] = None,
    base: Annotated[
        str | None, typer.Option(help="`name/version` to train further; left out: from nothing.")
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0, help="Of training, at most.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Likewise.")] = None,
    wait: Wait = False,
) -> None:
    """Train a model on a map, which needs no labels; surveys then name it with `--model`."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        accepted = client.train_model(map_id, name=name, base=base, minutes=minutes, epochs=epochs)
        model = accepted["model"]
        terminal.accepted(client, f"model {model}", accepted, wait, lambda: client.model(model), _whole)


def _table(cards: Sequence[Document]) -> Table:
    table = columns("model", "detector", "threshold", "summary")
    for card in cards:
        table.add_row(_name(card), *(str(card.get(key, "")) for key in ("detector", "threshold", "summary")))
    return table


def _whole(card: Document) -> Group:
    figures = columns("measured on", "area under ROC", "precision", "recall", "F1")
    for name, measured in card.get("evaluation", {}).items():
        if isinstance(measured, dict):
            values = (measured.get(key) for key in ("area_under_roc", "precision", "recall", "f1"))
            figures.add_row(name, *(number(value, 2) for value in values))
    return Group(facts({**card, "model": _name(card)}, "model", "summary", "threshold"), figures)


def _name(card: Document) -> str:
    return f"{card.get('name')}/{card.get('version')}"
