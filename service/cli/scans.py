"""`spicd scans`: files on their way in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from service.cli.completion import ScanId
from service.cli.tables import columns, facts, warnings
from service.cli.terminal import Captured, Device, Frame, Terminal, read_pose
from service.client import ClientError, Document


def add(
    ctx: typer.Context,
    files: Annotated[
        list[Path], typer.Argument(exists=True, dir_okay=False, help="PLY, PCD, E57, LAS or LAZ.")
    ],
    device_id: Device = None,
    captured_at: Captured = None,
    pose: Annotated[
        str | None,
        typer.Option(
            help="map_from_sensor: 'x y z qx qy qz qw' (metres, unit quaternion), 16 numbers row by row, or a file "
            "with either; without it the sidecar of the scan counts, hall.pose.txt or hall.pose.json of hall.ply."
        ),
    ] = None,
    frame: Frame = None,
) -> None:
    """Upload scans; the same bytes from the same device are one scan, and an upload that broke goes on."""
    terminal: Terminal = ctx.obj
    if pose is not None and len(files) > 1:
        raise ClientError("one pose belongs to one scan; add the files one at a time")
    terminal.require_whole(files)
    start = read_pose(pose) if pose else None
    about = {"device_id": device_id, "captured_at": captured_at, "pose": start, "frame": frame}
    terminal.ask(lambda client: [terminal.upload(client, file, **about) for file in files], _table)


def list_(ctx: typer.Context) -> None:
    """Every scan, newest first."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.scans(), _list_table)


def show(ctx: typer.Context, scan_id: ScanId) -> None:
    """What is known of one scan."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.scan(scan_id), _whole)


def delete(ctx: typer.Context, scan_id: ScanId) -> None:
    """Remove a scan that no map and no survey is made of."""
    terminal: Terminal = ctx.obj
    terminal.delete(lambda client: client.delete_scan(scan_id), f"scan {scan_id}", scan_id=scan_id)


def _list_table(scans: Sequence[Document]) -> Table:
    table = columns("scan", "file", "bytes", "device", "captured", "pose", "warnings")
    for scan in scans:
        posed = "" if scan.get("pose") is None else "yes"
        about = (scan.get(name) for name in ("device_id", "captured_at"))
        row = (scan["scan_id"], scan["filename"], f"{scan['size']:,}", *about, posed, warnings(scan))
        table.add_row(*row)
    return table


def _whole(scan: Document) -> Table:
    pose = scan.get("pose")
    rows = None if pose is None else "\n".join(" ".join(f"{number:9.4f}" for number in row) for row in pose)
    shown = {"scan": scan["scan_id"], "file": scan["filename"], "bytes": f"{scan['size']:,}", **scan}
    names = ("scan", "file", "format", "bytes", "sha256", "device_id", "captured_at", "frame", "created")
    return facts(shown, *names, **{"pose (map_from_sensor)": rows, "warnings": warnings(scan)})


def _table(scans: Sequence[Document]) -> Table:
    table = columns("scan", "file", "bytes", "sha256", "warnings")
    for scan in scans:
        table.add_row(
            scan["scan_id"],
            scan.get("filename", ""),
            f"{scan.get('size', 0):,}",
            scan["sha256"][:16],
            warnings(scan),
        )
    return table
