"""`spicd maps`: reference maps."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.console import Group
from rich.table import Table
from rich.text import Text

from service.cli.scans import Captured, Device
from service.cli.terminal import Terminal, columns
from service.client import Document

Scans = Annotated[list[str], typer.Argument(help="Files, which are uploaded, or ids of scans.")]
Wait = Annotated[bool, typer.Option("--wait", help="Follow the job to its end.")]
Model = Annotated[str | None, typer.Option(help="`name/version`; `spicd models` lists them.")]

_ACCEPTED: dict[bool | None, Text] = {True: Text("yes", style="green"), False: Text("no", style="red")}


def register(commands: typer.Typer) -> None:
    """Add `maps` to the command line."""
    group = typer.Typer(no_args_is_help=True, help="Reference maps.")
    group.command("create")(create)
    group.command("list")(list_)
    group.command("show")(show)
    group.command("delete")(delete)
    commands.add_typer(group, name="maps")


def create(
    ctx: typer.Context,
    scans: Scans,
    map_id: Annotated[str | None, typer.Option("--id", help="Id of the map; left out: one is made.")] = None,
    name: Annotated[str | None, typer.Option(help="For people.")] = None,
    model: Model = None,
    device_id: Device = None,
    captured_at: Captured = None,
    wait: Wait = False,
) -> None:
    """Build a map of scans."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        ids = terminal.scan_ids(client, scans, device_id=device_id, captured_at=captured_at)
        accepted = client.create_map(ids, map_id=map_id, name=name, model=model)
        if not wait:
            terminal.show(accepted, lambda: accepted_line("map", accepted))
            return
        terminal.wait(client, accepted["job_id"])
        found = client.map(accepted["map_id"])
    terminal.show(found, lambda: _whole(found))


def list_(ctx: typer.Context) -> None:
    """Every map."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.maps()
    terminal.show(found, lambda: _table(found))


def show(ctx: typer.Context, map_id: str) -> None:
    """One map with its scans."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.map(map_id)
    terminal.show(found, lambda: _whole(found))


def delete(ctx: typer.Context, map_id: str) -> None:
    """Remove a map with its versions and surveys."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        client.delete_map(map_id)
    terminal.show({"map_id": map_id, "deleted": True}, lambda: f"map {map_id} is deleted")


def accepted_line(what: str, accepted: Document) -> str:
    """What to say of work that was taken and not waited for."""
    job_id = accepted["job_id"]
    return f"{what} {accepted[f'{what}_id']}: job {job_id} is on its way, `spicd jobs {job_id}` shows it"


def facts(rows: list[tuple[str, Any]]) -> Table:
    """Names and values in two columns, without those that are not there."""
    table = Table(show_header=False, box=None)
    for name, value in rows:
        if value not in (None, "", {}):
            table.add_row(Text(name, style="bold"), str(value))
    return table


def counts(document: Document) -> str:
    """`changed 3, unchanged 40`."""
    return ", ".join(
        f"{name.replace('_', ' ')} {number}" for name, number in document.get("counts", {}).items()
    )


def scan_table(scans: list[Document]) -> Table:
    """How each scan was registered."""
    table = columns("scan", "accepted", "fitness", "rmse (m)", "sigma (m)", "reason")
    for scan in scans:
        table.add_row(
            scan["scan_id"],
            _ACCEPTED.get(scan.get("accepted"), Text()),
            number(scan.get("fitness"), 2),
            number(scan.get("rmse"), 3),
            number(scan.get("translation_sigma"), 3),
            scan.get("reason"),
        )
    return table


def number(value: float | None, digits: int) -> str:
    """A number, or nothing."""
    return "" if value is None else f"{value:.{digits}f}"


def _corners(bounds: Document | None) -> str:
    return (
        " to ".join(", ".join(f"{value:.2f}" for value in bounds[end]) for end in ("min", "max"))
        if bounds
        else ""
    )


def _table(maps: list[Document]) -> Table:
    table = columns("map", "name", "status", "scans", "counts", "created")
    for one in maps:
        scans = str(len(one.get("scans", [])))
        table.add_row(one["map_id"], one.get("name"), one["status"], scans, counts(one), one.get("created"))
    return table


def _whole(found: Document) -> Group:
    about = facts(
        [
            ("map", found["map_id"]),
            ("name", found.get("name")),
            ("version", found.get("version")),
            ("status", found["status"]),
            ("model", found.get("model")),
            ("counts", counts(found)),
            ("bounds (m)", _corners(found.get("bounds"))),
        ]
    )
    return Group(about, scan_table(found.get("scans", [])))
