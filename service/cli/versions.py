"""`spicd versions`: the states of a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table

from service.cli.completion import MapId
from service.cli.tables import columns, counts, facts, scan_table, with_all_scans
from service.cli.terminal import Captured, Device, Terminal, Wait
from service.client import Client, Document

Further = Annotated[
    list[str] | None, typer.Argument(help="Further scans: files, which are uploaded, or ids of scans.")
]


def add(
    ctx: typer.Context,
    map_id: MapId,
    scans: Further = None,
    survey: Annotated[str | None, typer.Option(help="Take over what this survey found changed.")] = None,
    device_id: Device = None,
    captured_at: Captured = None,
    wait: Wait = False,
) -> None:
    """Go on from the version in use, with further scans or an accepted survey."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        ids = terminal.scan_ids(client, scans or [], device_id=device_id, captured_at=captured_at)
        accepted = client.create_version(map_id, ids, survey_id=survey)
        version = accepted["version"]
        name = f"version {version} of map {map_id}"
        terminal.accepted(client, name, accepted, wait, lambda: _asked(client, map_id, version), _whole)


def list_(ctx: typer.Context, map_id: MapId) -> None:
    """Every version of a map."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.versions(map_id), _table)


def show(ctx: typer.Context, map_id: MapId, version: int) -> None:
    """One version with its scans."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: _asked(client, map_id, version), _whole)


def delete(ctx: typer.Context, map_id: MapId, version: int) -> None:
    """Remove a version that is not in use; surveys compared with it stay."""
    terminal: Terminal = ctx.obj
    name = f"version {version} of map {map_id}"
    terminal.delete(
        lambda client: client.delete_version(map_id, version), name, map_id=map_id, version=version
    )


def _asked(client: Client, map_id: str, version: int) -> Document:
    told = client.version(map_id, version)
    return with_all_scans(told, lambda: client.version_scans(map_id, version))


def _made_from(one: Document) -> str:
    base, survey_id = one.get("base_version"), one.get("survey_id")
    if base is None:
        return "scans"
    return f"version {base} and {f'survey {survey_id}' if survey_id else 'further scans'}"


def _table(versions: Sequence[Document]) -> Table:
    table = columns("version", "status", "made from", "scans", "counts", "created")
    for one in versions:
        scans = str(one.get("scan_count", len(one.get("scans", []))))
        table.add_row(
            str(one["version"]), one["status"], _made_from(one), scans, counts(one), one.get("created")
        )
    return table


def _whole(document: Document) -> Group:
    about = {"map": document["map_id"], **document}
    rows = {"made from": _made_from(document), "counts": counts(document)}
    return Group(facts(about, "map", "version", "status", **rows), scan_table(document))
