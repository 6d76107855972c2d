"""What every command has: the options that several take, the client, a place for results, and one for everything else.

Results go to stdout, as a table or, with `--json`, as JSON and nothing else. Progress, notes and errors go to stderr.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

from service.cli.tables import stage
from service.client import Client, ClientError, Document, JobFailed, OnProgress, Pose
from service.resumable import OnSent, default_memory
from service.robots.scan_files import FileNotWhole, require_whole
from service.robots.sidecars import SidecarError, read_pose_text, read_sidecar

T = TypeVar("T")

Scans = Annotated[list[str], typer.Argument(help="Files, which are uploaded, or ids of scans.")]
Captured = Annotated[str | None, typer.Option("--captured-at", help="RFC 3339, with its zone.")]
Device = Annotated[str | None, typer.Option("--device-id", help="Which robot or scanner.")]
Frame = Annotated[
    str | None, typer.Option("--frame", help="Name of the frame that the poses lead to, such as map or odom.")
]
Model = Annotated[str | None, typer.Option(help="`name/version`; `spicd models` lists them.")]
Wait = Annotated[bool, typer.Option("--wait", help="Follow the job to its end.")]

NOTED_WAIT_S = 5.0
RESUMABLE_FROM = 256 << 10  #: bytes; a smaller file goes in one request, which is as soon sent again
PIPE_WIDTH = 160  #: characters; where nobody says how wide the place is that stdout goes to
_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(kw_only=True, slots=True)
class Terminal:
    """The global options and the two consoles; a command finds it as `ctx.obj`."""

    url: str
    as_json: bool
    # No markup and no emoji codes: what is printed are names that people and files have, brackets and all.
    out: Console = field(
        default_factory=lambda: Console(
            width=None if sys.stdout.isatty() else PIPE_WIDTH, markup=False, emoji=False
        )
    )
    err: Console = field(default_factory=lambda: Console(stderr=True, markup=False, emoji=False))

    def client(self) -> Client:
        """Return the API, to be opened for the length of a command."""
        return Client(self.url)

    def ask(self, call: Callable[[Client], T], table: Callable[[T], Any]) -> None:
        """Call the API and print its answer."""
        with self.client() as client:
            answer = call(client)
        self.show(answer, table)

    def show(self, document: T, table: Callable[[T], Any]) -> None:
        """Print a result: the document itself with `--json`, otherwise what `table` makes of it."""
        if self.as_json:
            self._print_json(document)
        else:
            self.out.print(table(document))

    def delete(self, call: Callable[[Client], None], name: str, **ids: Any) -> None:
        """Have the API delete a thing, and say that it is gone."""
        with self.client() as client:
            call(client)
        self.show({**ids, "deleted": True}, lambda _: f"{name} is deleted")

    def accepted(
        self,
        client: Client,
        name: str,
        accepted: Document,
        wait: bool,
        result: Callable[[], Document],
        table: Callable[[Document], Any],
    ) -> None:
        """Say that a job is on its way; with `wait` follow it to its end, and print its `result`."""
        job_id = accepted["job_id"]
        if wait:
            self.wait(client, job_id)
            self.show(result(), table)
        else:
            self.show(
                accepted, lambda _: f"{name}: job {job_id} is on its way, `spicd jobs {job_id}` shows it"
            )

    def line(self, text: str) -> None:
        """Print one line of a result that comes line by line, as it is."""
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()

    def note(self, text: str) -> None:
        """Tell a person something that is no result."""
        self.err.print(text, highlight=False, soft_wrap=True)

    def fail(self, text: str) -> None:
        """Say in one line what went wrong."""
        self.err.print(text, style="bold red", highlight=False, soft_wrap=True)

    def download(self, client: Client, path: str, to: Path) -> Path:
        """Fetch one file under a progress bar, or the rest of it where an earlier attempt left a part.

        Raises `ClientError`, and OSError where it cannot be written.
        """
        with self._bar(_title(), BarColumn(), DownloadColumn()) as bar:
            task = bar.add_task(to.name, total=None)
            return client.download(
                path,
                to,
                lambda received, size: bar.update(task, completed=received, total=size),
                resume=True,
            )

    def upload(self, client: Client, path: Path, **about: Any) -> Document:
        """Send one file under a progress bar, resumed where it was broken off; what its sidecar says counts as said.

        Raises `ClientError`, also where the file cannot be read.
        """
        with self.sending(path.name) as on_sent:
            try:
                said = read_sidecar(path) | {
                    name: value for name, value in about.items() if value is not None
                }
                if path.stat().st_size < RESUMABLE_FROM:
                    return client.upload_scan(path, on_sent=on_sent, **said)
                return client.upload_scan_resumable(
                    path, memory=default_memory(), on_sent=on_sent, on_wait=self.waiting, **said
                )
            except SidecarError as error:
                raise ClientError(str(error)) from error
            except OSError as error:
                raise ClientError(f"{path}: the file cannot be read ({error.strerror or error})") from error

    @contextlib.contextmanager
    def sending(self, name: str) -> Iterator[OnSent]:
        """Show a progress bar of a file that is sent; yields what is told how far it is."""
        with self._bar(_title(), BarColumn(), DownloadColumn()) as bar:
            task = bar.add_task(name, total=None)
            yield lambda sent, size: bar.update(task, completed=sent, total=size)

    def waiting(self, seconds: float, why: str) -> None:
        """Say that the service does not answer, and when it is asked again; short waits are not worth a line."""
        if seconds >= NOTED_WAIT_S:
            self.note(f"{why}; next attempt in {seconds:.0f} s")

    def require_whole(self, files: Sequence[Path]) -> None:
        """Raise ClientError for files that cannot be a scan, by their headers, before anything of them is sent."""
        wrong = []
        for path in files:
            try:
                require_whole(path)
            except FileNotWhole as error:
                wrong.append(f"{path}: {error}")
            except OSError as error:
                wrong.append(f"{path}: the file cannot be read ({error.strerror or error})")
        if wrong:
            rest = [f"none of the {len(files)} files is sent"] if len(files) > 1 else []
            raise ClientError("; ".join(wrong + rest))

    def scan_ids(self, client: Client, names: Sequence[str], **about: Any) -> list[str]:
        """Return ids of the named scans: files are uploaded first, other names are taken as ids.

        Raises ClientError, also where one of the files is cut off; then none of them is sent.
        """
        wrong = [name for name in names if not Path(name).is_file() and not _ID.fullmatch(name)]
        if wrong:
            raise ClientError(f"{', '.join(wrong)}: no such file, and not the id of a scan")
        self.require_whole([Path(name) for name in names if Path(name).is_file()])
        return [
            self.upload(client, Path(name), **about)["scan_id"] if Path(name).is_file() else name
            for name in names
        ]

    def wait(self, client: Client, job_id: str) -> Document:
        """Follow a job under a progress bar; Ctrl-C stops the looking, not the job.

        Raises `JobFailed`; with `--json` the job's document is printed first, for it is the only result there is.
        """
        columns = (_title(), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        try:
            with self._bar(*columns) as bar:
                return client.wait(job_id, _advance(bar))
        except JobFailed as failed:
            if self.as_json:
                self._print_json(failed.job)
            raise
        except KeyboardInterrupt:
            self.note(f"job {job_id} goes on; `spicd jobs {job_id}` shows it, `--cancel` stops it")
            raise typer.Exit(130) from None

    @staticmethod
    def _print_json(document: Any) -> None:
        sys.stdout.write(json.dumps(document, indent=2, ensure_ascii=False) + "\n")

    def _bar(self, *columns: Any) -> Progress:
        hidden = self.as_json or not self.err.is_terminal
        return Progress(*columns, console=self.err, transient=True, disable=hidden)


def _title() -> TextColumn:
    """Return the column that says what a bar is about, as it is: a file name may look like markup."""
    return TextColumn("{task.description}", style="bold", markup=False)


def _advance(bar: Progress) -> OnProgress:
    task = bar.add_task("waiting", total=100)

    def advance(job: Document) -> None:
        bar.update(task, description=stage(job), completed=job.get("progress") or 0)

    return advance


#: What the API tells its own clients to ask, and which command asks that.
_COMMANDS = (
    (r"GET /maps/<id>/surveys", r"`spicd surveys list MAP`"),
    (r"GET /maps/([\w-]+)/versions", r"`spicd versions list \1`"),
    (r"GET /maps/([\w-]+)/objects", r"`spicd objects \1`"),
    (r"GET /surveys/([\w-]+)/tiles", r"`spicd surveys download \1`"),
    (r"GET /maps\b(?!/)", r"`spicd maps list`"),
    (r"GET /jobs\b(?!/)", r"`spicd jobs`"),
    (r"GET /models\b(?!/)", r"`spicd models`"),
    (r"GET /webhooks\b(?!/)", r"`spicd webhooks list`"),
)


def in_commands(sentence: str) -> str:
    """Return a sentence of the API with the commands of this command line in place of its calls."""
    for call, command in _COMMANDS:
        sentence = re.sub(call, command, sentence)
    return sentence


def read_pose(given: str) -> Pose:
    """Read a pose: a file, or the numbers themselves. Raises `ClientError`.

    Either has a 4x4 as JSON or as sixteen numbers row by row, or `x y z qx qy qz qw`.
    """
    path = Path(given)
    try:
        is_file = path.is_file()
    except OSError:  # too long for a name
        is_file = False
    try:
        return read_pose_text(path.read_text() if is_file else given)
    except (OSError, ValueError, TypeError) as error:
        raise ClientError(f"{given[:100]}: the pose cannot be read: {error}") from error
