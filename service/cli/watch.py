"""`spicd scans watch`: what a robot writes into a folder is sent, however bad its Wi-Fi is."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from service.cli.terminal import Device, Frame, Terminal
from service.client import ClientError, Document, RequestRefused, Unreachable
from service.resumable import OnSent, Persistence
from service.robots.watching import Reporter, SurveyEach, Watcher, WatchOptions

REFUSED_STATUS = 3  #: of --once where a file was refused
NOTED_S = 2.0  #: a shorter wait is not worth a line
SAID_AGAIN_S = 600.0  #: that the service still does not answer


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
        typer.Option(
            "--once",
            help="Send what is there and end; every sub-folder's visit counts as over. Status 3: a file was refused.",
        ),
    ] = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="With --once: end when the surveys have ended, too.")
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
      FOLDER/done/hall.2.ply             likewise, where that name is taken
      FOLDER/refused/hall.ply            it is cut off, empty or no scan, and
      FOLDER/refused/hall.ply.why.json   says why

    Of a refused scan: mend it and move it with its sidecar back into its folder; a visit that is over becomes a
    further survey. The why.json goes once the scan is sent.

    With --map, only sub-folders become surveys (or each file, with --survey-each file), and the map has to exist:
    `spicd maps list`. A sub-folder is removed with its visit's survey unless something is left in it. When a survey has
    ended a line says what it found; more of it:

    \b
      spicd surveys list MAP
      spicd surveys show ID
      spicd objects MAP --survey ID

    Where the scan was taken may lie beside it, and is written before it: hall.pose.txt with "x y z qx qy qz qw"
    (metres, unit quaternion) or 16 numbers of a 4x4 row by row, or hall.pose.json:

    \b
      {"pose": [2.5, 0, 0.35, 0, 0, 0, 1], "frame": "map",
       "captured_at": "2026-03-01T12:00:00Z", "device_id": "robot-7"}

    The pose takes points from the sensor's axes (x forward, y left, z up) to the frame. It is a start: a scan without
    one is placed as well. Without captured_at the time counts at which the file was last written.

    Uploads go on where they were broken off, after a lost connection, a killed watcher and a restart of the service.
    While the service is away the watcher waits, longer each time up to half a minute, or as long as the service says.
    What it knows is in FOLDER/.spicd; run one watcher for a folder. SIGTERM and Ctrl-C end it, with status 0. Status 1:
    the service refuses to be asked, say for an unknown key or map, or --once finds nobody at the address.

    \b
      spicd scans watch /data/scans --device-id robot-7
      spicd scans watch /data/visits --map lobby --visit-ends 120
      spicd scans watch /data/scans --once --json

    With --json each event is a JSON object on a line of its own: scan, refused, stray, survey, survey_ended.

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
        wait=wait,
        persistence=Persistence() if once else Persistence(idle_s=math.inf),
    )
    outage = Outage(note=terminal.note, url=terminal.url)
    report = Reporter(
        event=lambda sentence, document: _tell(terminal, outage, sentence, document),
        sending=lambda path: _bar(terminal, outage, path),
        waiting=outage.waiting,
    )
    with (
        _ended_by_signals(),
        terminal.client() as client,
        Watcher(client, folder, options, report) as watcher,
    ):
        outage.left = lambda: watcher.left
        try:
            _begin(terminal, watcher, folder, map_id, once=once)
            if once:
                watcher.run_once()
            else:
                watcher.run()
        except KeyboardInterrupt:
            pass  # what came of an upload that was under way is at the service
        _sum_up(terminal, watcher, map_id)
        if once and watcher.refused:
            raise typer.Exit(REFUSED_STATUS)


@dataclass(kw_only=True)
class Outage:
    """Says once that the service does not answer, rarely that it still does not, and that it answers again."""

    note: Callable[[str], None]
    url: str
    left: Callable[[], int] = lambda: 0  #: scans that wait
    _why: str | None = None
    _said: float = 0.0

    def waiting(self, seconds: float, why: str) -> None:
        """Hear of a wait before the next attempt."""
        is_new = why != self._why
        if seconds < NOTED_S or (not is_new and time.monotonic() - self._said < SAID_AGAIN_S):
            return
        self._why, self._said = why, time.monotonic()
        scans = self.left()
        waits = f"{scans} scans wait" if scans != 1 else "1 scan waits"
        self.note(f"{_clock()} {why}; {waits}, next attempt in {seconds:.0f} s")

    def over(self) -> None:
        """Hear that something went through."""
        if self._why is not None and "answer" in self._why:  # and not a map that still builds
            self.note(f"{_clock()} {self.url} answers again")
        self._why = None


def _clock() -> str:
    return time.strftime("%H:%M:%S")


def _begin(terminal: Terminal, watcher: Watcher, folder: Path, map_id: str | None, *, once: bool) -> None:
    """Say what is watched for whom. Raises ClientError for a key or map that is not known, and with nothing to send."""
    what = f"watching {folder} for {terminal.url}"
    try:
        found = watcher.check()
    except RequestRefused as refused:
        if refused.status == 404 and map_id is not None:
            raise ClientError(
                f"no map {map_id!r}; `spicd maps list` shows those there are, "
                f"`spicd maps create SCAN --id {map_id}` makes one"
            ) from refused
        if refused.status not in (408, 429) and refused.status < 500:
            raise
        terminal.note(f"{what}, which is not ready: {refused}")
        return
    except Unreachable:
        if once and not watcher.left:
            raise
        terminal.note(f"{what}, where nobody answers yet; scans wait until somebody does")
        return
    of_map = "" if map_id is None else f", map {map_id}"
    if found is not None:
        of_map += (
            f" (version {found['version']}{'' if found['status'] == 'ready' else ', ' + found['status']})"
        )
    terminal.note(what + of_map)


def _sum_up(terminal: Terminal, watcher: Watcher, map_id: str | None) -> None:
    terminal.note(f"{watcher.sent} sent, {watcher.refused} refused, {watcher.surveys} surveys")
    if watcher.surveys_under_way:
        terminal.note(
            f"{watcher.surveys_under_way} surveys are under way; `spicd surveys list {map_id or 'MAP'}` shows them"
        )


def _tell(terminal: Terminal, outage: Outage, sentence: str, document: Document) -> None:
    if document["event"] in ("scan", "survey", "survey_ended"):
        outage.over()
    if terminal.as_json:
        sys.stdout.write(json.dumps(document, ensure_ascii=False) + "\n")
        sys.stdout.flush()
    else:
        terminal.note(sentence)


@contextlib.contextmanager
def _bar(terminal: Terminal, outage: Outage, path: Path) -> Iterator[OnSent]:
    """Show how far a file is; the first call of each attempt says that the service has answered."""
    with terminal.sending(path.name) as on_sent:

        def sent(done: int, size: int) -> None:
            outage.over()
            on_sent(done, size)

        yield sent


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
