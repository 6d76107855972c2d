"""`spicd webhooks`: addresses that events are sent to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table

from service.cli.completion import maps
from service.cli.tables import columns, facts
from service.cli.terminal import Terminal
from service.client import Document


def add(
    ctx: typer.Context,
    url: Annotated[str, typer.Argument(help="https://...; asked by POST.")],
    event_type: Annotated[
        list[str] | None, typer.Option("--type", help="Such as survey.ready; repeat it; left out: all.")
    ] = None,
    map_id: Annotated[
        str | None, typer.Option("--map", help="Of this map only.", autocompletion=maps)
    ] = None,
) -> None:
    """Have events sent to an address. The secret of the signatures is shown now and never again."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        made = client.create_webhook(url, types=event_type, map_id=map_id)
    terminal.note("keep the secret now: it is not shown again")
    terminal.show(made, _whole)


def list_(ctx: typer.Context) -> None:
    """Every webhook."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.webhooks(), _table)


def remove(ctx: typer.Context, webhook_id: str) -> None:
    """Have no more events sent."""
    terminal: Terminal = ctx.obj
    name = f"webhook {webhook_id}"
    terminal.delete(lambda client: client.delete_webhook(webhook_id), name, webhook_id=webhook_id)


def ping(ctx: typer.Context, webhook_id: str) -> None:
    """Have an event sent that says nothing but that it arrives."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        sent = client.ping_webhook(webhook_id)
    terminal.show(sent, lambda _: f"a ping is on its way to webhook {webhook_id}")


def rotate(ctx: typer.Context, webhook_id: str) -> None:
    """Change the secret; for a day what is sent bears the signatures of both."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        changed = client.rotate_webhook(webhook_id)
    terminal.show(changed, _whole)


def deliveries(ctx: typer.Context, webhook_id: str) -> None:
    """What was sent, and what is still to be."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.deliveries(webhook_id), _delivery_table)


def repeat(ctx: typer.Context, webhook_id: str, delivery_id: str) -> None:
    """Have an event sent once more, under the same id."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        sent = client.repeat_delivery(webhook_id, delivery_id)
    terminal.show(sent, lambda _: f"event {sent['event_id']} is on its way to webhook {webhook_id}")


def _about(webhook: Document) -> dict[str, str]:
    return {
        "webhook": webhook["webhook_id"],
        "url": webhook["url"],
        "types": ", ".join(webhook.get("types") or ()) or "all",
        "map": webhook.get("map_id") or "all",
        "status": webhook.get("status") or "",
        "reason": webhook.get("reason") or "",
    }


def _table(webhooks: Sequence[Document]) -> Table:
    table = columns("webhook", "url", "types", "map", "status", "reason")
    for webhook in webhooks:
        table.add_row(*_about(webhook).values())
    return table


def _whole(webhook: Document) -> Group:
    about = {**_about(webhook), "secret": webhook.get("secret")}
    return Group(facts(about, *about))


def _delivery_table(deliveries: Sequence[Document]) -> Table:
    names = ("delivery_id", "event_id", "kind", "type", "status", "attempts", "answered", "error")
    table = columns("delivery", "event", *names[2:])
    for delivery in deliveries:
        table.add_row(*(str(delivery.get(name) or "") for name in names))
    return table
