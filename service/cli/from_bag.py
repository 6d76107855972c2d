"""`spicd scans from-bag`: a recording of ROS as scans."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table

from service.cli.tables import columns
from service.cli.terminal import Device, Terminal
from service.client import ClientError, Document
from service.robots.bags.recording import BagError, BagOptions, BagScan, Recording, write


def from_bag(
    ctx: typer.Context,
    bag: Annotated[Path, typer.Argument(exists=True, help="Folder of rosbag2, or an .mcap or .db3 file.")],
    to: Annotated[
        Path | None, typer.Option("--to", file_okay=False, help="Write scans and sidecars into this folder.")
    ] = None,
    upload: Annotated[bool, typer.Option("--upload", help="Send the scans; their ids go to stdout.")] = False,
    topic: Annotated[
        str | None, typer.Option(help="Of the clouds (PointCloud2); left out: the only one that there is.")
    ] = None,
    pose_topic: Annotated[
        str | None,
        typer.Option("--pose-topic", help="Odometry or PoseStamped; left out: /tf and /tf_static."),
    ] = None,
    body_frame: Annotated[
        str | None,
        typer.Option(
            "--body-frame", help="Whose poses a PoseStamped has, say base_link; left out: the sensor's."
        ),
    ] = None,
    frame: Annotated[
        str | None, typer.Option("--frame", help="That the poses lead to; left out: map, or else odom.")
    ] = None,
    each: Annotated[
        Literal["stop", "time"],
        typer.Option("--each", help="A scan of each stop, or one every so many seconds."),
    ] = "stop",
    every: Annotated[float, typer.Option(min=0.05, help="With --each time: seconds.")] = 5.0,
    stop: Annotated[
        float, typer.Option("--stop", min=0, help="With --each stop: seconds that it lasts at least.")
    ] = 1.0,
    device_id: Device = None,
) -> None:
    """Make scans of a recording of ROS (MCAP, rosbag2), each with its pose, frame and time.

    A stop is where the sensor moves by less than 2 cm and turns by less than 1 degree; what it saw there, 20 clouds at
    most, is one scan. The pose of a scan takes points from the sensor's frame to --frame, by the transforms of the
    recording, interpolated at the time of the cloud. A pose in `odom` is taken as if it were one in the map: where the
    two differ by more than a metre or so, leave poses out or localize first (--frame map). Give --device-id: scans of
    two robots with the same bytes are told apart by it.

    \b
      spicd scans from-bag patrol.mcap --to /data/visits/monday       files for `spicd scans watch`
      spicd scans from-bag patrol/ --topic /lidar/points --each time --every 2 --upload

    Needs the package rosbags: pip install 'spicd\\[ros]'.
    """
    if (to is None) == (not upload):
        raise ClientError("say where the scans go: --to FOLDER, or --upload")
    terminal: Terminal = ctx.obj
    options = BagOptions(
        topic=topic,
        pose_topic=pose_topic,
        body_frame=body_frame,
        frame=frame,
        each=each,
        every_s=every,
        least_stop_s=stop,
    )
    try:
        made = (
            _written(terminal, bag, options, to, device_id)
            if to
            else _sent(terminal, bag, options, device_id)
        )
    except BagError as error:
        raise ClientError(str(error)) from error
    terminal.show(made, _table)


def _written(
    terminal: Terminal, bag: Path, options: BagOptions, folder: Path, device_id: str | None
) -> list[Document]:
    folder.mkdir(parents=True, exist_ok=True)
    with Recording(bag) as recording:
        made: list[Document] = [
            {"file": str(write(scan, folder, _name(bag, number), device_id=device_id)), **_about(scan)}
            for number, scan in enumerate(recording.scans(options), 1)
        ]
        _tell_of_rest(terminal, recording, made)
    return made


def _sent(terminal: Terminal, bag: Path, options: BagOptions, device_id: str | None) -> list[Document]:
    made: list[Document] = []
    with (
        Recording(bag) as recording,
        terminal.client() as client,
        tempfile.TemporaryDirectory(prefix="spicd-bag-") as folder,
    ):
        for number, scan in enumerate(recording.scans(options), 1):
            path = write(scan, Path(folder), _name(bag, number), device_id=device_id)
            made.append(
                {"file": path.name, **_about(scan), "scan_id": terminal.upload(client, path)["scan_id"]}
            )
            path.unlink()
        _tell_of_rest(terminal, recording, made)
    return made


def _tell_of_rest(terminal: Terminal, recording: Recording, made: list[Document]) -> None:
    for why, count in recording.skipped.items():
        terminal.note(f"{count} clouds without a pose: {why}")
    if not made:
        raise ClientError("the robot stood nowhere for long enough; lower --stop, or take --each time")


def _name(bag: Path, number: int) -> str:
    return f"{bag.stem}-{number:04}"


def _about(scan: BagScan) -> Document:
    return {"points": sum(cloud.count for cloud in scan.clouds), **scan.said()}


def _table(made: list[Document]) -> Table:
    table = columns("file", "points", "x y z (m)", "frame", "time", "scan")
    for one in made:
        position = " ".join(f"{row[3]:.2f}" for row in one["pose"][:3])
        table.add_row(
            one["file"], f"{one['points']:,}", position, one["frame"], one["captured_at"], one.get("scan_id")
        )
    return table
