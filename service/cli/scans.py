"""`spicd scans`: files on their way in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from service.cli.tables import columns, warnings
from service.cli.terminal import Captured, Device, Frame, Terminal, read_pose
from service.client import ClientError, Document


def add(
    ctx: typer.Context,
    files: Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="PLY or PCD.")],
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
    start = read_pose(pose) if pose else None
    about = {"device_id": device_id, "captured_at": captured_at, "pose": start, "frame": frame}
    terminal.ask(lambda client: [terminal.upload(client, file, **about) for file in files], _table)


def _table(scans: list[Document]) -> Table:
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
