"""Loads a service of its own as a site does: `python -m tests.breaking.load`.

Robots upload a scan each at 200 kB/s and hand in a survey of it, at once and one after another, while dashboards ask
for the changes. Exit status 1 where a request failed, a survey did not end well, or time ran out.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx

from tests.support.findings import Deadline, add_common, show
from tests.support.footprints import footprints, watched
from tests.support.running_service import ROOT, Service
from tests.support.traffic import Room, Upload, send_scan

MAP = "load"
_PATIENCE = 20  # times that a robot is told to come back later, before it gives up
_ENDED = ("successful", "failed", "dismissed")


@dataclass
class Figures:
    """What was measured, by many threads."""

    seconds: dict[str, list[float]] = field(
        default_factory=lambda: defaultdict(list)
    )  #: of each kind of request
    statuses: Counter[str] = field(default_factory=Counter)  #: `kind status`, of all that is not 2xx
    ready_s: dict[str, float] = field(default_factory=dict)  #: of a job, from the POST to its end
    ended: Counter[str] = field(default_factory=Counter)  #: jobs by status
    lock: threading.Lock = field(default_factory=threading.Lock)

    def timed(self, kind: str, ask: Callable[[], httpx.Response]) -> httpx.Response | None:
        """Ask, and note how long it took and what came of it; None where no answer came."""
        begun = time.perf_counter()
        try:
            answer = ask()
        except httpx.TransportError as error:
            with self.lock:
                self.statuses[f"{kind} {type(error).__name__}"] += 1
            return None
        with self.lock:
            self.seconds[kind].append(time.perf_counter() - begun)
            if not answer.is_success:
                self.statuses[f"{kind} {answer.status_code}"] += 1
        return answer


@dataclass(frozen=True)
class Load:
    """A run: where, how much, and until when."""

    url: str
    options: argparse.Namespace
    deadline: Deadline
    figures: Figures
    over: threading.Event = field(default_factory=threading.Event)

    def client(self) -> httpx.Client:
        """Return a client of its own, as each robot and dashboard has."""
        return httpx.Client(base_url=self.url, timeout=60)

    def robot(self, uploads: list[Upload]) -> None:
        """Send one scan and hand in its survey after the other, until none is left."""
        with self.client() as http:
            while uploads and not self.deadline.over():
                try:
                    upload = uploads.pop()
                except IndexError:
                    return
                self._survey(http, upload)

    def _survey(self, http: httpx.Client, upload: Upload) -> None:
        sent = self._asked("upload", lambda: send_scan(http, upload, bytes_a_second=self.options.rate))
        if sent is not None:
            body = {"scan_ids": [sent.json()["scan_id"]]}
            self._asked("survey", lambda: http.post(f"/maps/{MAP}/surveys", json=body))

    def _asked(self, kind: str, ask: Callable[[], httpx.Response]) -> httpx.Response | None:
        """Ask until it is done, as often as the service says that it is to come back later."""
        for _ in range(_PATIENCE):
            answer = self.figures.timed(kind, ask)
            if answer is not None and answer.status_code not in (429, 503):
                return answer if answer.is_success else None
            wait = 1.0 if answer is None else float(answer.headers.get("Retry-After", 1))
            if self.over.wait(wait):
                return None
        return None

    def dashboard(self) -> None:
        """Ask for the changes again and again."""
        with self.client() as http:
            while not self.over.wait(self.options.poll):
                self.figures.timed("changes", lambda: http.get(f"/maps/{MAP}/changes"))

    def await_surveys(self, wanted: int) -> None:
        """Wait until so many jobs of surveys ended, or time is up; note how each did."""
        with self.client() as http:
            while not self.deadline.over():
                jobs = [job for job in _jobs(http) if job["processID"] == "survey"]
                ended = [job for job in jobs if job["status"] in _ENDED]
                if len(ended) >= wanted:
                    break
                time.sleep(1)
        for job in ended:
            self.figures.ready_s[job["jobID"]] = _instant(job["finished"]) - _instant(job["created"])
            self.figures.ended[job["status"]] += 1


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    with ExitStack() as stack:
        room = Room()
        service = stack.enter_context(started())
        build_map(service, room)
        load = Load(service.url, options, Deadline(options.minutes), Figures())
        uploads = [room.survey_upload(number) for number in range(options.surveys)]
        most = stack.enter_context(watched(service.process.pid))
        begun = time.monotonic()
        run(load, uploads)
        seconds = time.monotonic() - begun
        atend = {name: taken.resident for name, taken in footprints(service.process.pid).items()}
    rows, document = report(load.figures, options, seconds, dict(most), atend)
    show(rows, document, options.json)
    bad = {name: count for name, count in load.figures.statuses.items() if not name.endswith("429")}
    return 1 if bad or load.figures.ended["successful"] < options.surveys else 0


def run(load: Load, uploads: list[Upload]) -> None:
    """Have robots and dashboards at work until all surveys have ended."""
    wanted = len(uploads)
    with ThreadPoolExecutor(load.options.robots + load.options.dashboards) as threads:
        robots = [threads.submit(load.robot, uploads) for _ in range(load.options.robots)]
        screens = [threads.submit(load.dashboard) for _ in range(load.options.dashboards)]
        try:
            load.await_surveys(wanted)
        finally:
            load.over.set()
        for done in (*robots, *screens):
            done.result()


@contextmanager
def started(**settings: str) -> Any:
    """Give a service of its own in a folder that goes."""
    with TemporaryDirectory(prefix="spicd-load-") as folder:
        service = Service(Path(folder), ROOT / "model_store")
        try:
            yield service
        finally:
            service.end()


def build_map(service: Service, room: Room) -> None:
    """Build the map that the surveys are held against."""
    ids = [send_scan(service.http, upload).json()["scan_id"] for upload in room.map_uploads()]
    service.succeeded(service.post("/maps", id=MAP, scan_ids=ids)["job_id"])


def report(
    figures: Figures, options: argparse.Namespace, seconds: float, most: dict[str, int], atend: dict[str, int]
) -> tuple[dict[str, object], dict[str, Any]]:
    """Return the figures as rows of a table, and as a document."""
    ready = list(figures.ready_s.values())
    parts = {**figures.seconds, "from POST to ready": ready}
    document = {
        "robots": options.robots,
        "surveys": options.surveys,
        "dashboards": options.dashboards,
        "seconds": round(seconds, 1),
        "surveys_a_minute": round(60 * len(ready) / seconds, 1),
        "seconds_of": {
            kind: {"count": len(taken), **{f"p{p}": round(percentile(taken, p), 4) for p in (50, 99)}}
            for kind, taken in parts.items()
            if taken
        },
        "not_2xx": dict(figures.statuses),
        "jobs": dict(figures.ended),
        "peak_bytes": most,
        "end_bytes": atend,
    }
    rows: dict[str, object] = {
        "surveys": f"{dict(figures.ended)} in {seconds:.0f} s, {60 * len(ready) / seconds:.1f} a minute",
        **{
            kind: f"p50 {percentile(taken, 50):.3f} s, p99 {percentile(taken, 99):.3f} s, {len(taken)} times"
            for kind, taken in parts.items()
            if taken
        },
        "not 2xx": dict(figures.statuses) or "none",
        **{
            f"memory of {name}": f"{bytes_ / 1e6:.0f} MB at most, {atend.get(name, 0) / 1e6:.0f} MB at the end"
            for name, bytes_ in sorted(most.items())
        },
    }
    return rows, document


def percentile(values: list[float], share: float) -> float:
    """Return the value that `share` percent of them do not exceed (nearest rank)."""
    return sorted(values)[max(0, math.ceil(len(values) * share / 100) - 1)]


def _jobs(http: httpx.Client) -> list[dict[str, Any]]:
    try:
        return list(http.get("/jobs", params={"limit": 1000}).raise_for_status().json()["jobs"])
    except (httpx.HTTPError, json.JSONDecodeError):
        return []


def _instant(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.load", description=__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--surveys", type=int, default=50)
    parser.add_argument("--dashboards", type=int, default=5)
    parser.add_argument("--rate", type=float, default=200_000, help="bytes a second that a robot uploads")
    parser.add_argument("--poll", type=float, default=1.0, help="seconds between two looks of a dashboard")
    add_common(parser, minutes=15)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
