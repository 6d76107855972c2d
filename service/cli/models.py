"""`spicd models`: what can score tiles, and a model of one's own."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.console import Group
from rich.table import Table

from service.cli.maps import Wait, facts
from service.cli.terminal import Terminal, columns
from service.client import Document


def register(commands: typer.Typer) -> None:
    """Add `models` to the command line."""
    group = typer.Typer(
        invoke_without_command=True,
        help="Models that score tiles; alone, it lists them.",
        no_args_is_help=False,
    )
    group.callback()(list_)
    group.command("train")(train)
    commands.add_typer(group, name="models")


def list_(ctx: typer.Context) -> None:
    """The models that can score tiles, those of the site among them."""
    if ctx.invoked_subcommand is not None:
        return
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.models()
    terminal.show(found, lambda: _table(found))


def train(
    ctx: typer.Context,
    map_id: str,
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
        if not wait:
            terminal.show(accepted, lambda: _accepted_line(accepted))
            return
        terminal.wait(client, accepted["job_id"])
        card = client.model(accepted["model"])
    terminal.show(card, lambda: _whole(card))


def _accepted_line(accepted: Document) -> str:
    job_id = accepted["job_id"]
    return f"model {accepted['model']}: job {job_id} is on its way, `spicd jobs {job_id}` shows it"


def _table(cards: list[Document]) -> Table:
    table = columns("model", "detector", "threshold", "summary")
    for card in cards:
        name = f"{card.get('name')}/{card.get('version')}"
        table.add_row(
            name, str(card.get("detector", "")), str(card.get("threshold", "")), str(card.get("summary", ""))
        )
    return table


def _whole(card: Document) -> Group:
    about = facts(
        [
            ("model", f"{card.get('name')}/{card.get('version')}"),
            ("summary", card.get("summary")),
            ("threshold", card.get("threshold")),
        ]
    )
    figures = columns("measured on", "area under ROC", "precision", "recall", "F1")
    for name, measured in card.get("evaluation", {}).items():
        if isinstance(measured, dict):
            figures.add_row(
                name, *(_two(measured.get(key)) for key in ("area_under_roc", "precision", "recall", "f1"))
            )
    return Group(about, figures)


def _two(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, int | float) else ""
