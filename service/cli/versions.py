"""`spicd versions`: the states of a map."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table

from service.cli.maps import Wait, counts, facts, scan_table
from service.cli.scans import Captured, Device
from service.cli.terminal import Terminal, columns
from service.client import Document

Further = Annotated[
    list[str] | None, typer.Argument(help="Further scans: files, which are uploaded, or ids of scans.")
]


def register(commands: typer.Typer) -> None:
    """Add `versions` to the command line."""
    group = typer.Typer(no_args_is_help=True, help="Versions of a map.")
    group.command("add")(add)
    group.command("list")(list_)
    group.command("show")(show)
    group.command("delete")(delete)
    commands.add_typer(group, name="versions")


def add(
    ctx: typer.Context,
    map_id: str,
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
        if not wait:
            terminal.show(accepted, lambda: _accepted_line(accepted))
            return
        terminal.wait(client, accepted["job_id"])
        found = client.version(map_id, accepted["version"])
    terminal.show(found, lambda: _whole(found))


def list_(ctx: typer.Context, map_id: str) -> None:
    """Every version of a map."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.versions(map_id)
    terminal.show(found, lambda: _table(found))


def show(ctx: typer.Context, map_id: str, version: int) -> None:
    """One version with its scans."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.version(map_id, version)
    terminal.show(found, lambda: _whole(found))


def delete(ctx: typer.Context, map_id: str, version: int) -> None:
    """Remove a version that is not in use; surveys compared with it stay."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        client.delete_version(map_id, version)
    gone = {"map_id": map_id, "version": version, "deleted": True}
    terminal.show(gone, lambda: f"version {version} of map {map_id} is deleted")


def _accepted_line(accepted: Document) -> str:
    job_id = accepted["job_id"]
    name = f"version {accepted['version']} of map {accepted['map_id']}"
    return f"{name}: job {job_id} is on its way, `spicd jobs {job_id}` shows it"


def _made_from(one: Document) -> str:
    base, survey_id = one.get("base_version"), one.get("survey_id")
    if base is None:
        return "scans"
    return f"version {base} and {f'survey {survey_id}' if survey_id else 'further scans'}"


def _table(versions: list[Document]) -> Table:
    table = columns("version", "status", "made from", "scans", "counts", "created")
    for one in versions:
        scans = str(len(one.get("scans", [])))
        table.add_row(
            str(one["version"]), one["status"], _made_from(one), scans, counts(one), one.get("created")
        )
    return table


def _whole(found: Document) -> Group:
    about = facts(
        [
            ("map", found["map_id"]),
            ("version", found["version"]),
            ("status", found["status"]),
            ("made from", _made_from(found)),
            ("counts", counts(found)),
        ]
    )
    return Group(about, scan_table(found.get("scans", [])))
