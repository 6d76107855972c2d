"""`spicd maps`: reference maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table

from service.cli.completion import MapId
from service.cli.tables import columns, counts, facts, point, scan_table, with_all_scans
from service.cli.terminal import Captured, Device, Model, Scans, Terminal, Wait
from service.client import Client, ClientError, Document


def create(
    ctx: typer.Context,
    scans: Scans,
    map_id: Annotated[str | None, typer.Option("--id", help="Id of the map; left out: one is made.")] = None,
    name: Annotated[str | None, typer.Option(help="For people.")] = None,
    model: Model = None,
    alarms_per_survey: Annotated[
        float | None,
        typer.Option("--alarms-per-survey", help="False objects that a visit without changes may have."),
    ] = None,
    device_id: Device = None,
    captured_at: Captured = None,
    wait: Wait = False,
) -> None:
    """Build a map of scans.

    Of each file the sidecar counts, hall.pose.json or hall.pose.txt of hall.ply, and is where its registration starts:
    `spicd scans watch --help` says what is in one. The frame of the map is the one that the poses lead to, or that of one
    of the scans where there are none; metres, z up.
    """
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        ids = terminal.scan_ids(client, scans, device_id=device_id, captured_at=captured_at)
        settings = None if alarms_per_survey is None else {"alarms_per_survey": alarms_per_survey}
        accepted = client.create_map(ids, map_id=map_id, name=name, model=model, settings=settings)
        map_id = accepted["map_id"]
        terminal.accepted(client, f"map {map_id}", accepted, wait, lambda: _asked(client, map_id), _whole)


def list_(ctx: typer.Context) -> None:
    """Every map."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.maps(), _table)


def show(ctx: typer.Context, map_id: MapId) -> None:
    """One map with its scans."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: _asked(client, map_id), _whole)


def anchor(
    ctx: typer.Context,
    map_id: MapId,
    longitude: Annotated[float | None, typer.Option(help="Of the map's origin, WGS 84, degrees.")] = None,
    latitude: Annotated[float | None, typer.Option(help="Likewise.")] = None,
    height: Annotated[float, typer.Option(help="Metres above the ellipsoid.")] = 0.0,
    heading: Annotated[
        float, typer.Option(help="Degrees, clockwise from true north to the map's x axis.")
    ] = 0.0,
    remove: Annotated[bool, typer.Option("--remove", help="Nobody knows where it lies.")] = False,
) -> None:
    """Say where a map lies on the Earth, so that answers have longitude and latitude; alone: show it."""
    terminal: Terminal = ctx.obj
    if (longitude is None) != (latitude is None) or (remove and longitude is not None):
        raise ClientError(
            "give --longitude and --latitude, or --remove, or neither to see where the map lies"
        )
    with terminal.client() as client:
        if remove:
            client.set_anchor(map_id, None)
        elif longitude is not None:
            place = {"longitude": longitude, "latitude": latitude, "height": height, "heading": heading}
            client.set_anchor(map_id, place)
        placed = client.map(map_id)["anchor"]
    terminal.show({"map_id": map_id, "anchor": placed}, _anchor)


def delete(ctx: typer.Context, map_id: MapId) -> None:
    """Remove a map with its versions and surveys."""
    terminal: Terminal = ctx.obj
    terminal.delete(lambda client: client.delete_map(map_id), f"map {map_id}", map_id=map_id)


def _asked(client: Client, map_id: str) -> Document:
    return with_all_scans(client.map(map_id), lambda: client.map_scans(map_id))


def _table(maps: Sequence[Document]) -> Table:
    table = columns("map", "name", "status", "scans", "counts", "created")
    for one in maps:
        scans = str(one.get("scan_count", len(one.get("scans", []))))
        table.add_row(one["map_id"], one.get("name"), one["status"], scans, counts(one), one.get("created"))
    return table


def _anchor(document: Document) -> Table | str:
    place = document["anchor"]
    if place is None:
        return f"nobody said where map {document['map_id']} lies"
    return facts({"map": document["map_id"], **place}, "map", "longitude", "latitude", "height", "heading")


def _whole(document: Document) -> Group:
    bounds = document.get("bounds")
    corners = bounds and f"{point(bounds['min'])} to {point(bounds['max'])}"
    about = {"map": document["map_id"]}
    rows = {"counts": counts(document), "objects": counts(document, "objects"), "bounds (m)": corners}
    return Group(
        facts({**about, **document}, "map", "name", "version", "status", "model", **rows),
        scan_table(document),
    )
