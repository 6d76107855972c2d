"""`spicd scans watch`: what a robot writes into a folder is sent, however bad its Wi-Fi is."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from service.cli.terminal import Device, Frame, Terminal
from service.client import Document
from service.resumable import OnSent, Persistence
from service.watching import Reporter, SurveyEach, Watcher, WatchOptions


def watch(
    ctx: typer.Context,
    folder: Annotated[
        Path, typer.Argument(exists=True, file_okay=False, writable=True, help="Where the scans appear.")
    ],
    map_id: Annotated[
        str | None,
        typer.Option("--map", help="Submit surveys of this map; left out: scans are sent, no more."),
    ] = None,
    survey_each: Annotated[
        SurveyEach,
        typer.Option(
            "--survey-each", help="With --map: a survey of each sub-folder, or of each file by itself."
        ),
    ] = "folder",
    visit_ends: Annotated[
        float,
        typer.Option(
            "--visit-ends",
            min=0,
            help="Seconds without a further scan after which a sub-folder's visit is over.",
        ),
    ] = 300.0,
    settle: Annotated[
        float, typer.Option(min=0, help="Seconds that a file has to stay as it is before it counts as whole.")
    ] = 3.0,
    once: Annotated[
        bool,
        typer.Option("--once", help="Send what is there and end; every sub-folder's visit counts as over."),
    ] = False,
    device_id: Device = None,
    frame: Frame = None,
) -> None:
    """Send every scan that appears in a folder, and go on for ever.

    Write scans (.ply, .pcd, .e57, .las, .laz) into FOLDER, or into a sub-folder for each visit. A file is sent once it has not changed
    for --settle seconds; give it its name when it is whole (hall.ply.part renamed to hall.ply) and none is sent half.
    Names that begin with a dot or end in .part, .partial, .tmp or ~ are left alone, and so is all that is no scan.

    \b
    What becomes of a scan:
      FOLDER/done/hall.ply               the service has it
      FOLDER/refused/hall.ply            the service does not take it, and
      FOLDER/refused/hall.ply.why.json   says why

    Where the scan was taken may lie beside it, and is written before it: hall.pose.txt with "x y z qx qy qz qw"
    (metres, unit quaternion) or 16 numbers of a 4x4 row by row, or hall.pose.json:

    \b
      {"pose": [2.5, 0, 0.35, 0, 0, 0, 1], "frame": "map",
       "captured_at": "2026-03-01T12:00:00Z", "device_id": "robot-7"}

    The pose takes points from the sensor's axes (x forward, y left, z up) to the frame. It is a start: a scan without
    one is placed as well.

    Uploads go on where they were broken off, after a lost connection, a killed watcher and a restart of the service.
    While the service is away the watcher waits, longer each time up to half a minute, or as long as the service says.
    What it knows is in FOLDER/.spicd; run one watcher for a folder. SIGTERM and Ctrl-C end it, with status 0. Status 1:
    the service refuses to be asked, say for an unknown key or map.

    \b
      spicd scans watch /data/scans --url https://spicd.example.org --device-id robot-7
      spicd scans watch /data/visits --map lobby --visit-ends 120
      spicd --json scans watch /data/scans --once      one JSON object a line for each scan, refusal and survey

    SPICD_URL and SPICD_KEY name the service and the API key (scopes scans:write and, with --map, surveys:write).
    """
    terminal: Terminal = ctx.obj
    options = WatchOptions(
        settle_s=settle,
        visit_ends_s=visit_ends,
        map_id=map_id,
        survey_each=survey_each,
        device_id=device_id,
        frame=frame,
        persistence=Persistence() if once else Persistence(idle_s=math.inf),
    )
    report = Reporter(
        event=lambda sentence, document: _tell(terminal, sentence, document),
        sending=lambda path: _bar(terminal, path),
        waiting=terminal.waiting,
    )
    with (
        _ended_by_signals(),
        terminal.client() as client,
        Watcher(client, folder, options, report) as watcher,
    ):
        try:
            if once:
                watcher.run_once()
            else:
                terminal.note(f"watching {folder}")
                watcher.run()
        except KeyboardInterrupt:
            pass  # what came of an upload that was under way is at the service
        terminal.note(f"{watcher.sent} sent, {watcher.refused} refused, {watcher.surveys} surveys")


def _tell(terminal: Terminal, sentence: str, document: Document) -> None:
    if terminal.as_json:
        sys.stdout.write(json.dumps(document, ensure_ascii=False) + "\n")
        sys.stdout.flush()
    else:
        terminal.note(sentence)


@contextlib.contextmanager
def _bar(terminal: Terminal, path: Path) -> Iterator[OnSent]:
    with terminal.sending(path.name) as on_sent:
        yield on_sent


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Have SIGTERM end what runs as Ctrl-C does, at the next instruction."""

    def end(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
