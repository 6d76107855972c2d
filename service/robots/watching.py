"""Sends what appears in a folder: a robot writes scans there, and finds them in `done/` or in `refused/`.

    FOLDER/hall.ply              a scan, and beside it what is said of it (service/robots/sidecars.py)
    FOLDER/monday/hall.ply       the scan of a visit
    FOLDER/done/...              what the service has
    FOLDER/refused/...           what it does not take, and `hall.ply.why.json` beside it
    FOLDER/.spicd/               state: uploads that are begun, visits and surveys that are under way, and a lock

Everything is written so that a watcher that was killed goes on: a file that was sent is known by its upload, and is not
sent twice; a survey is submitted under an `Idempotency-Key` of its visit.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Self

from service.client import Client, ClientError, Document, RequestRefused, Unreachable
from service.resumable import FileChanged, Memory, OnSent, OnWait, Persistence, write_aside
from service.robots.following import Following
from service.robots.scan_files import FileNotWhole, require_whole
from service.robots.sidecars import SUFFIXES as SIDECARS
from service.robots.sidecars import SidecarError, read_sidecar, sidecar_of

DONE, REFUSED, STATE = "done", "refused", ".spicd"
SUFFIXES = (".ply", ".pcd", ".e57", ".las", ".laz")
SurveyEach = Literal["file", "folder"]
_UNFINISHED = (".part", ".partial", ".tmp", ".crdownload", "~")
_NO_FAULT_OF_THE_FILE = frozenset({401, 403, 404, 405, 412})
_LONGEST_NAME = 255  #: letters that the service keeps of a file's name
#: A robot whose clock was never set writes files of 1970 or of the day its image was made; that is no time of a scan.
_CLOCKS_ARE_SET = datetime(2020, 1, 1, tzinfo=UTC).timestamp()
_A_SCAN_OF_NO_ID = "none"


class FolderBusy(ClientError):
    """Another watcher is at the folder."""


@dataclass(frozen=True, kw_only=True, slots=True)
class WatchOptions:
    """How a folder is watched."""

    settle_s: float = 3.0  #: so long a file has to stay as it is before it is whole
    cut_off_s: float = (
        30.0  #: so long a file that is cut off has to stay as it is before nobody writes to it any more
    )
    visit_ends_s: float = 300.0  #: so long nothing is added to a sub-folder before its visit is over
    every_s: float = 1.0  #: between two looks
    follow_s: float = 5.0  #: between two questions after surveys that are under way
    wait: bool = False  #: `run_once` ends when the surveys have ended, too
    map_id: str | None = None  #: of the surveys; None: scans are sent and nothing more
    survey_each: SurveyEach = "folder"
    device_id: str | None = None
    frame: str | None = None
    persistence: Persistence = field(default_factory=Persistence)


@dataclass(kw_only=True)
class Reporter:
    """Whom the watcher tells what happens; each may be left out."""

    event: Callable[[str, Document], None] = lambda _sentence, _document: None
    sending: Callable[[Path], contextlib.AbstractContextManager[OnSent]] = lambda _path: (
        contextlib.nullcontext(lambda _sent, _size: None)
    )
    waiting: OnWait = lambda _seconds, _why: None


class UntilMoved(Memory):
    """Uploads of which the file may still lie where it was: they are known until it is moved, and not sent again."""

    was_known = False  #: of the file that was sent last: the service had it before

    def ended(self, key: str, *, known: bool = False) -> None:  # noqa: ARG002  # it is the only one
        """Keep it."""
        self.was_known = known

    def moved(self) -> None:
        """Drop all, once the file is where it belongs; one is sent at a time."""
        self.was_known = False
        self._urls.clear()
        self._save()


class State:
    """What was sent of visits that are under way: `visits.json` in the folder's state, replaced whole."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "visits.json"
        self._visits: dict[str, dict[str, str]] = {}
        with contextlib.suppress(FileNotFoundError):
            self._visits = json.loads(self._path.read_text())

    def names(self) -> list[str]:
        """Return the visits that are under way."""
        return sorted(self._visits)

    def scans(self, visit: str) -> list[str]:
        """Return the ids of the scans of a visit, in the order of their names, each once."""
        entries = self._visits.get(visit, {})
        return list(dict.fromkeys(entries[name] for name in sorted(entries)))

    def files(self, visit: str) -> dict[str, list[str]]:
        """Return the names of the files of each scan of a visit, by the scan's id."""
        named: dict[str, list[str]] = {}
        for name, scan_id in sorted(self._visits.get(visit, {}).items()):
            named.setdefault(scan_id, []).append(name)
        return named

    def add(self, visit: str, name: str, scan_id: str) -> None:
        """Note a scan of a visit."""
        self._visits.setdefault(visit, {})[name] = scan_id
        self._save()

    def end(self, visit: str) -> None:
        """Forget a visit whose survey is submitted."""
        self._visits.pop(visit, None)
        self._save()

    def _save(self) -> None:
        write_aside(self._path, json.dumps(self._visits, indent=1))


class Watcher:
    """Watches one folder; a context manager, that holds the folder against a second one. Raises FolderBusy."""

    def __init__(
        self, client: Client, folder: Path, options: WatchOptions, report: Reporter | None = None
    ) -> None:
        self._client, self._folder, self._options = client, folder, options
        self._report = report or Reporter()
        self._later: dict[
            str, tuple[float, int]
        ] = {}  #: visits to be submitted again: not before, and after how many
        self._seen: dict[Path, tuple[tuple[int, int], float]] = {}  #: size and time of change, and since when
        self._cut_off: dict[Path, tuple[int, int]] = {}  #: as `_seen`: files that may still be written to
        self._strays: set[Path] = set()  #: sidecars without a scan that were told of
        self.sent = self.refused = self.surveys = 0

    def __enter__(self) -> Self:
        state = self._folder / STATE
        state.mkdir(exist_ok=True)
        self._lock = (state / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise FolderBusy(f"another watcher is at {self._folder}") from None
        self._memory = UntilMoved(state / "uploads.json")
        self._state = State(state)
        self._surveys = Following(self._client, state / "surveys.json", every_s=self._options.follow_s)
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.close()

    @property
    def left(self) -> int:
        """How many scans are there and not sent."""
        return sum(1 for _ in self._present())

    @property
    def surveys_under_way(self) -> int:
        """How many surveys are submitted and have not ended."""
        return len(self._surveys)

    def check(self) -> Document | None:
        """Ask whether service, key and map are as they should be; the map, None without or where the key may not see it.

        Raises ClientError; its `status` is 404 where there is no such map.
        """
        if self._options.map_id is not None:
            try:
                return self._client.map(self._options.map_id)
            except RequestRefused as refused:
                if refused.status != 403:
                    raise
        try:
            self._client.scan(_A_SCAN_OF_NO_ID)  # a key that may send scans may ask for one
        except RequestRefused as refused:
            if refused.status != 404 or "type" not in refused.problem:
                raise
        return None

    def run(self) -> None:
        """Go on for ever. Raises ClientError for what no later attempt mends, such as a key that is not known."""
        while True:
            self.look()
            time.sleep(self._options.every_s)

    def run_once(self) -> None:
        """Send what is there, and end once nothing is left; every visit counts as over. Raises ClientError."""
        while self.look(visits_are_over=True):
            time.sleep(self._options.every_s)
        self._tell_strays(at_once=True)

    def look(self, *, visits_are_over: bool = False) -> bool:
        """Send what is whole by now, and submit what is over; whether anything is left that may become so."""
        present = list(self._present())
        whole = [path for path in present if self._is_whole(path)]
        for path in whole:
            self._take(path, at_once=visits_are_over)
        self._cut_off = {path: stamp for path, stamp in self._cut_off.items() if path.exists()}
        self._seen = {path: seen for path, seen in self._seen.items() if path.exists()}
        left = len(present) > len(whole)
        if self._options.map_id is not None:
            for visit in self._state.names():
                left |= not (self._is_over(visit, visits_are_over) and self._submit(visit))
        self._tell_strays()
        for sentence, event in self._surveys.ended():
            self._report.event(sentence, event)
        return left or (self._options.wait and bool(self._surveys))

    def _present(self) -> Iterator[Path]:
        """Yield the scans in the folder and in its sub-folders, in order of their names."""
        for path in sorted(self._folder.iterdir()):
            if path.name.startswith(".") or path.name in (DONE, REFUSED):
                continue
            inside = sorted(path.iterdir()) if path.is_dir() else [path]
            yield from (file for file in inside if _is_scan(file))

    def _is_whole(self, path: Path) -> bool:
        """Whether a file, and what lies beside it, has stayed as it is for long enough."""
        try:
            stamp = _stamp(path)
        except FileNotFoundError:
            return False
        known, since = self._seen.get(path, ((-1, -1), 0.0))
        if known != stamp:
            self._seen[path] = (stamp, time.monotonic())
            return self._options.settle_s == 0
        is_cut_off = self._cut_off.get(path) == stamp
        return time.monotonic() - since >= (self._options.cut_off_s if is_cut_off else self._options.settle_s)

    def _take(self, path: Path, *, at_once: bool) -> None:
        """Send one scan, and move it to where it belongs; one that is cut off stays a while, unless `at_once`."""
        try:
            require_whole(path)
            said = self._said(path)
            scan = self._send(path, said)
        except FileNotWhole as error:
            stamp = self._seen[path][0]
            if not at_once and self._cut_off.get(path) != stamp:
                self._cut_off[path] = stamp
                return
            self._refuse(path, {"title": "The file is no whole scan", "detail": str(error)})
        except SidecarError as error:
            self._refuse(path, {"title": "What lies beside the scan cannot be used", "detail": str(error)})
        except RequestRefused as refused:
            if refused.status in _NO_FAULT_OF_THE_FILE:
                raise
            self._refuse(path, refused.problem)
        except ClientError as error:
            if not isinstance(error.__cause__, FileChanged):
                raise
            self._seen.pop(path, None)  # it was not whole yet
        except FileNotFoundError:
            return  # taken away by who put it there
        except OSError as error:
            self._refuse(path, {"title": "The file cannot be read", "detail": error.strerror or str(error)})
        else:
            self._keep(path, scan, said)

    def _said(self, path: Path) -> dict[str, Any]:
        """Return what is said of a scan: by its sidecar, by the options, and by the file itself. Raises SidecarError."""
        name = str(path.relative_to(self._folder))
        written = path.stat().st_mtime
        captured_at = None
        if _CLOCKS_ARE_SET <= written <= time.time():
            captured_at = datetime.fromtimestamp(int(written), UTC).isoformat().replace("+00:00", "Z")
        return {
            "filename": name if len(name) <= _LONGEST_NAME and name.isprintable() else path.name,
            "captured_at": captured_at,
            "device_id": self._options.device_id,
            "frame": self._options.frame,
            **read_sidecar(path),
        }

    def _send(self, path: Path, said: dict[str, Any]) -> Document:
        """Send a scan, however long it takes; when the service stays away it is asked again and again."""
        with self._report.sending(path) as on_sent:
            return self._client.upload_scan_resumable(
                path,
                memory=self._memory,
                persistence=self._options.persistence,
                on_sent=on_sent,
                on_wait=self._report.waiting,
                **said,
            )

    def _keep(self, path: Path, scan: Document, said: dict[str, Any]) -> None:
        relative = path.relative_to(self._folder)
        visit = self._visit_of(relative)
        if visit is not None:
            self._state.add(visit, relative.name, scan["scan_id"])
        was_known, has_pose = self._memory.was_known, said.get("pose") is not None
        self._move(path, DONE)
        self._memory.moved()
        self._forget_refusal(relative)
        self.sent += 1
        remarks = [] if has_pose else ["no pose"]
        if was_known:
            remarks.append(
                "already there" + ("; its pose is now the one beside this file" if has_pose else "")
            )
        if visit is None and self._options.map_id is not None:
            remarks.append(
                "no survey: it lies in no sub-folder; use --survey-each file, or one folder for each visit"
            )
        told = {
            "event": "scan",
            "file": str(relative),
            "scan_id": scan["scan_id"],
            "size": scan.get("size"),
            "has_pose": has_pose,
            "was_known": was_known,
            "visit": visit,
        }
        self._report.event("; ".join([f"{relative}: sent, {scan['scan_id']}", *remarks]), told)

    def _visit_of(self, relative: Path) -> str | None:
        """Return the visit that a scan is of; None where no survey is asked for with it."""
        if self._options.map_id is None:
            return None
        if self._options.survey_each == "file":
            return str(relative)
        return relative.parts[0] if len(relative.parts) > 1 else None

    def _forget_refusal(self, relative: Path) -> None:
        """Remove why a scan was refused before, once it is sent: it was mended and moved back."""
        refused = self._folder / REFUSED / relative
        if not refused.exists():
            refused.with_name(f"{refused.name}.why.json").unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # others lie there
                refused.parent.rmdir()

    def _tell_strays(self, visit: str | None = None, *, at_once: bool = False) -> None:
        """Say once of each sidecar that it belongs to no scan, as soon as none is likely to come."""
        folders = [self._folder / visit] if visit else [self._folder, *self._visits()]
        for folder in folders:
            for path in sorted(folder.glob("*.pose.*")) if folder.is_dir() else ():
                is_due = at_once or time.time() - path.stat().st_mtime >= self._options.visit_ends_s
                if is_due and path not in self._strays and _is_stray(path):
                    self._strays.add(path)
                    name = str(path.relative_to(self._folder))
                    self._report.event(f"{name} belongs to no scan", {"event": "stray", "file": name})

    def _visits(self) -> list[Path]:
        """Return the sub-folders that scans are written into."""
        return [
            path
            for path in sorted(self._folder.iterdir())
            if path.is_dir() and not path.name.startswith(".") and path.name not in (DONE, REFUSED)
        ]

    def _refuse(self, path: Path, problem: Document) -> None:
        relative = path.relative_to(self._folder)
        moved = self._move(path, REFUSED)
        self._memory.moved()
        write_aside(moved.with_name(f"{moved.name}.why.json"), json.dumps(problem, indent=1))
        self.refused += 1
        sentence = ": ".join(str(problem[name]) for name in ("title", "detail") if problem.get(name))
        self._report.event(
            f"{relative}: refused, {sentence}",
            {"event": "refused", "file": str(relative), "problem": problem},
        )

    def _move(self, path: Path, to: str) -> Path:
        """Move a scan and its sidecar; a name that is taken gets a number."""
        target = self._folder / to / path.relative_to(self._folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        number, free = 2, target
        while free.exists():
            free, number = target.with_name(f"{target.stem}.{number}{target.suffix}"), number + 1
        sidecar = None
        with contextlib.suppress(SidecarError):
            sidecar = sidecar_of(path)
        path.replace(free)  # first: without its sidecar the same file would be another upload
        if sidecar is not None:
            sidecar.replace(free.with_name(free.stem + "".join(sidecar.suffixes[-2:])))
        return free

    def _is_over(self, visit: str, at_once: bool) -> bool:
        """Whether a visit gets no further scan: its folder has been still for long enough, or is gone."""
        folder = self._folder / visit
        if self._options.survey_each == "file" or not folder.is_dir():
            return True
        if any(_is_scan(path) for path in folder.iterdir()):
            return False
        return at_once or time.time() - folder.stat().st_mtime >= self._options.visit_ends_s

    def _submit(self, visit: str) -> bool:
        """Ask for the survey of a visit; False where the service has to be asked again. Raises RequestRefused."""
        not_before, failures = self._later.get(visit, (0.0, 0))
        if time.monotonic() < not_before:
            return False
        map_id, scans = self._options.map_id or "", self._state.scans(visit)
        try:
            answer = self._client.submit_survey(
                map_id,
                scans,
                device_id=self._options.device_id,
                idempotency_key=key_of(map_id, visit, scans),
            )
        except (Unreachable, RequestRefused) as error:
            if isinstance(error, RequestRefused) and not _may_pass(error):
                raise
            longest = min(30.0, 0.5 * 2 ** min(failures, 16))
            wait = secrets.SystemRandom().uniform(longest / 2, longest)
            self._later[visit] = (time.monotonic() + wait, failures + 1)
            self._report.waiting(wait, f"{visit}: {error}")
            return False
        self._surveys.add(answer["survey_id"], visit, self._state.files(visit))
        self._state.end(visit)
        self._later.pop(visit, None)
        if self._options.survey_each == "folder":
            self._tell_strays(visit, at_once=True)
        with contextlib.suppress(OSError):  # not empty: something that is no scan lies there
            (self._folder / visit).rmdir()
        self.surveys += 1
        told = {"event": "survey", "visit": visit, "scans": scans, **answer}
        self._report.event(f"{visit}: survey {answer['survey_id']} of {len(scans)} scans", told)
        return True


def key_of(map_id: str, visit: str, scans: list[str]) -> str:
    """Return the `Idempotency-Key` of a visit's survey."""
    return hashlib.sha256(json.dumps([map_id, visit, scans]).encode()).hexdigest()[:32]


def _may_pass(refused: RequestRefused) -> bool:
    """Whether a wait may mend a refusal: a map that still builds, a full queue, a part of the service that is away."""
    return refused.status in (408, 409, 423, 425, 429) or refused.status >= 500


def _is_stray(path: Path) -> bool:
    """Whether a file is a sidecar beside which no scan lies, whole or not."""
    suffix = next((suffix for suffix in SIDECARS if path.name.endswith(suffix)), None)
    if suffix is None or path.name.startswith("."):
        return False
    stem = path.name.removesuffix(suffix)
    beside = (other.name for other in path.parent.iterdir() if other.name.startswith(f"{stem}."))
    return all(name.endswith(SIDECARS) for name in beside)


def _is_scan(path: Path) -> bool:
    name = path.name.lower()
    return (
        not name.startswith(".")
        and not name.endswith(_UNFINISHED)
        and name.endswith(SUFFIXES)
        and path.is_file()
    )


def _stamp(path: Path) -> tuple[int, int]:
    """Return what changes while somebody writes to a scan or to what lies beside it."""
    status = path.stat()
    size, changed = status.st_size, status.st_mtime_ns
    with contextlib.suppress(SidecarError, FileNotFoundError):
        if (beside := sidecar_of(path)) is not None:
            status = beside.stat()
            size, changed = size + status.st_size, max(changed, status.st_mtime_ns)
    return size, changed
