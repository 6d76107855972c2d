"""Robots on bad Wi-Fi and dashboards that follow: `python -m tests.breaking.follow`.

Each robot uploads a scan through a link of its own that is slow and resets every connection after a few seconds, and
hands in a survey, whose visits come in out of order. Five dashboards follow the map meanwhile, through such links too:
two by Server-Sent Events, two by the cursor of /maps/{id}/changes, one by a webhook whose receiver fails now and then.
Exit status 1 where an upload arrived with another digest, a survey is there twice or did not end, or a dashboard has
missed a change that was told, was told one twice as new (a webhook: another event of the same change), or was told of
one that something of it changed before it was told the change.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

import httpx
from standardwebhooks.webhooks import Webhook

from service.resumable import Persistence, upload
from tests.support.findings import Deadline, Findings, add_common, show
from tests.support.flaky_link import FlakyLink, flaky_links
from tests.support.running_service import ROOT, Service
from tests.support.traffic import as_upload, send_scan
from tests.support.two_visits import free_place
from worker.cloud.formats.pcd import write_pcd
from worker.simulation.scenes import Scene, random_room
from worker.simulation.scenes.furniture import crate
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

MAP = "followed"
_FIRST_DAY = datetime(2026, 3, 1, 12, tzinfo=UTC)
_ENDED = ("successful", "failed", "dismissed")
_CATCH_UP_S = 90.0  #: after the last survey, for the slowest way to have told all


@dataclass
class Follower:
    """A dashboard: which changes it was told, and how often."""

    name: str
    told: Counter[str] = field(default_factory=Counter)  #: by id of the change
    events: Counter[str] = field(default_factory=Counter)  #: deliveries by id of the event, of a webhook
    connections: int = 0


@dataclass
class Scenario:
    """A run: the service, its links, and what came of it."""

    service: Service
    options: argparse.Namespace
    deadline: Deadline
    findings: Findings = field(default_factory=Findings)
    over: threading.Event = field(default_factory=threading.Event)
    upload_s: list[float] = field(default_factory=list)
    surveys: list[str] = field(default_factory=list)

    def robot(self, number: int, link: FlakyLink, path: Path, scan: SimulatedScan) -> None:
        """Upload a scan and hand in a survey of it, however often the link breaks."""
        with httpx.Client(base_url=link.url, timeout=20) as http:
            said = {"pose": json.dumps(scan.prior.tolist()), "device_id": f"robot-{number}"}
            begun = time.monotonic()
            document = upload(http, path, said=said, persistence=Persistence(idle_s=120))
            self.upload_s.append(time.monotonic() - begun)
            if document["sha256"] != hashlib.sha256(path.read_bytes()).hexdigest():
                self.findings.add("digest", f"{path.name} arrived as {document['sha256']}")
            when = _FIRST_DAY + timedelta(days=(7 * number) % self.options.robots)
            body = {"scan_ids": [document["scan_id"]], "captured_at": when.isoformat()}
            key = {"Idempotency-Key": str(uuid4())}
            answer = self._until_answered(http, f"/maps/{MAP}/surveys", body, key)
            self.surveys.append(answer["survey_id"])

    def _until_answered(self, http: httpx.Client, path: str, body: Any, headers: dict[str, str]) -> Any:
        while not self.deadline.over():
            try:
                answer = http.post(path, json=body, headers=headers)
            except httpx.TransportError:
                continue
            if answer.is_success:
                return answer.json()
            if answer.status_code not in (409, 429, 503):
                raise AssertionError(answer.text)
            time.sleep(1)
        raise AssertionError("time is over")

    def by_stream(self, follower: Follower, url: str) -> None:
        """Follow by Server-Sent Events, and go on behind the last event where the link breaks."""
        last = "0"
        with httpx.Client(base_url=url, timeout=30) as http:
            while not self.over.is_set():
                follower.connections += 1
                headers = {"Accept": "text/event-stream", "Last-Event-ID": last}
                try:
                    with http.stream("GET", "/events", params={"map": MAP}, headers=headers) as stream:
                        for name, value in _fields(stream):
                            if name == "id":
                                last = value
                            elif name == "data":
                                _note(follower, json.loads(value))
                except httpx.TransportError:
                    self.over.wait(0.2)

    def by_cursor(self, follower: Follower, url: str) -> None:
        """Follow by the cursor of the changes."""
        cursor = "0"
        with httpx.Client(base_url=url, timeout=30) as http:
            while not self.over.wait(1.0):
                try:
                    page = http.get(f"/maps/{MAP}/changes", params={"after": cursor}).json()
                except (httpx.TransportError, ValueError):
                    continue
                follower.connections += 1
                for feature in page["features"]:
                    if not feature["properties"]["updated"]:
                        follower.told[feature["id"]] += 1
                    elif not follower.told[feature["id"]]:
                        self.findings.add("updated", f"{follower.name}: {feature['id']} before it was told")
                cursor = page["cursor"]

    @contextmanager
    def by_webhook(self, follower: Follower) -> Iterator[None]:
        """Follow by a webhook, whose receiver refuses each seventh delivery."""
        with _receiver(follower, self.findings) as (url, set_secret):
            answer = self.service.http.post("/webhooks", json={"url": url, "map": MAP})
            answer.raise_for_status()
            set_secret(answer.json()["secret"])
            yield


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="spicd-follow-")))
        rng = random.Random(options.seed)
        room = random_room(5)
        scans = _visits(room, options.robots, rng)
        service = Service(
            folder, ROOT / "model_store", webhook_allowed_networks="127.0.0.0/8", min_free_bytes=0
        )
        stack.callback(service.end)
        _build_map(service, room)
        scenario = Scenario(service, options, Deadline(options.minutes))
        links = stack.enter_context(
            flaky_links(
                options.robots + 4, service.url, bytes_a_second=options.rate, drops_after_s=options.drops
            )
        )
        followers = run(scenario, links, scans, folder, stack)
        check(scenario, followers)
        rows, document = report(scenario, followers, links)
    show(rows, document, options.json)
    return 1 if scenario.findings.counts else 0


def run(
    scenario: Scenario,
    links: list[FlakyLink],
    scans: list[SimulatedScan],
    folder: Path,
    stack: ExitStack,
) -> list[Follower]:
    """Have robots and dashboards at work until every survey has ended and every dashboard had time to hear of it."""
    followers = [Follower(name) for name in ("stream 1", "stream 2", "cursor 1", "cursor 2", "webhook")]
    stack.enter_context(scenario.by_webhook(followers[4]))
    ways = (scenario.by_stream, scenario.by_stream, scenario.by_cursor, scenario.by_cursor)
    with ThreadPoolExecutor(len(links)) as threads:
        screens = [
            threads.submit(way, follower, link.url)
            for way, follower, link in zip(ways, followers, links, strict=False)
        ]
        robots = []
        for number, scan in enumerate(scans):
            path = folder / f"robot-{number}.pcd"
            write_pcd(path, scan.points)
            robots.append(threads.submit(scenario.robot, number, links[4 + number], path, scan))
        try:
            for robot in robots:
                robot.result()
            _await_jobs(scenario)
            _await_followers(scenario, followers)
        finally:
            scenario.over.set()
        for screen in screens:
            screen.result()
    return followers


def check(scenario: Scenario, followers: list[Follower]) -> None:
    """Hold what each dashboard was told against what the service has published."""
    told, findings = _published(scenario.service), scenario.findings
    findings.cases = len(told)
    for follower in followers:
        for change in told - follower.told.keys():
            findings.add("missed", f"{follower.name}: {change}")
        for change, times in follower.told.items():
            if times > 1:
                findings.add("doubled", f"{follower.name}: {change} {times} times")
    surveys = scenario.service.get(f"/maps/{MAP}/surveys?limit=1000")["surveys"]
    findings.outcomes.update(survey["status"] for survey in surveys)
    if len(surveys) != len(scenario.surveys) or findings.outcomes["ready"] != len(surveys):
        findings.add("surveys", f"{len(scenario.surveys)} handed in, {dict(findings.outcomes)} there")
    if not told:
        findings.add("nothing", "no change was told at all")


def report(
    scenario: Scenario, followers: list[Follower], links: list[FlakyLink]
) -> tuple[dict[str, object], dict[str, Any]]:
    """Return the figures as rows of a table, and as a document."""
    uploads, findings = sorted(scenario.upload_s), scenario.findings
    dropped = [link.dropped for link in links[4:]]
    rows: dict[str, object] = {
        "robots": f"{len(uploads)} uploads in {uploads[0]:.1f} to {uploads[-1]:.1f} s over links that broke "
        f"{min(dropped)} to {max(dropped)} times",
        "surveys": dict(findings.outcomes),
        "changes told": findings.cases,
    }
    for follower in followers:
        again = sum(times - 1 for times in follower.events.values())
        rows[follower.name] = f"{len(follower.told)} changes, {follower.connections} connections" + (
            f", {again} deliveries repeated" if follower.events else ""
        )
    rows["findings"] = dict(findings.counts) or "none"
    for kind, words in findings.kept.items():
        rows[f"  {kind}"] = "; ".join(words)
    return rows, findings.document(upload_s=uploads, dropped=dropped, seed=scenario.options.seed)


def _published(service: Service) -> set[str]:
    """Return the ids of all changes that were ever told, withdrawn ones too."""
    told: set[str] = set()
    cursor, page = "0", None
    while page is None or page["events"]:
        page = service.get(f"/events?after={cursor}&map={MAP}&type=change.told&limit=1000")
        told |= {event["subject"] for event in page["events"]}
        cursor = page["cursor"]
    return told


def _await_jobs(scenario: Scenario) -> None:
    while not scenario.deadline.over():
        jobs = scenario.service.get("/jobs?limit=1000")["jobs"]
        if all(job["status"] in _ENDED for job in jobs):
            return
        time.sleep(0.5)


def _await_followers(scenario: Scenario, followers: list[Follower]) -> None:
    told, until = _published(scenario.service), time.monotonic() + _CATCH_UP_S
    while time.monotonic() < until and any(told - follower.told.keys() for follower in followers):
        time.sleep(0.5)
    time.sleep(3)  # in which something might be told twice


def _fields(stream: httpx.Response) -> Iterator[tuple[str, str]]:
    for line in stream.iter_lines():
        name, _, value = line.partition(":")
        yield name, value.removeprefix(" ")


def _note(follower: Follower, event: dict[str, Any]) -> None:
    if event["type"] == "change.told":
        follower.told[event["subject"]] += 1


@contextmanager
def _receiver(follower: Follower, findings: Findings) -> Iterator[tuple[str, Any]]:
    """Give the URL of a webhook's receiver; what has no valid signature is a finding."""
    secrets: list[str] = []

    class Receiver(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            follower.connections += 1
            if follower.connections % 7 == 0:
                self._answer(503)
                return
            try:
                event = Webhook(secrets[0]).verify(body, dict(self.headers.items()))
            except Exception as error:
                findings.add("signature", f"{type(error).__name__}: {error}")
                self._answer(400)
                return
            follower.events[self.headers["webhook-id"]] += 1
            if follower.events[self.headers["webhook-id"]] == 1:  # a receiver knows a repeated one by its id
                _note(follower, event)
            self._answer(204)

        def _answer(self, status: int) -> None:
            self.send_response(status)
            self.end_headers()

        def log_message(self, *_: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Receiver) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/", secrets.append
        server.shutdown()


def _visits(room: Scene, count: int, rng: random.Random) -> list[SimulatedScan]:
    """Return one scan of each visit, in which crates stand at some of several places."""
    low, high = room.rooms[0].low, room.rooms[0].high
    corners = [(x, y) for x in (low[0] + 0.8, high[0] - 0.8) for y in (low[1] + 0.8, high[1] - 0.8)]
    places = sorted({free_place(room, around=(float(x), float(y))) for x, y in corners})
    scans = []
    for number in range(count):
        scene = room
        for place in places:
            if rng.random() < 0.5:
                scene, _ = scene.with_added(
                    f"crate-{place[0]:.2f}-{place[1]:.2f}", crate(0.7, 0.5, 0.6).at(*place)
                )
        scans.append(visit(scene, 1, seed=10 + number, prior_error=(0.05, 1.0), duration_s=5.0)[0])
    return scans


def _build_map(service: Service, room: Scene) -> None:
    scans = visit(room, 4, seed=1, duration_s=5.0)
    uploads = [as_upload(f"map-{number}", scan.points, scan.prior) for number, scan in enumerate(scans)]
    ids = [send_scan(service.http, one).json()["scan_id"] for one in uploads]
    service.succeeded(service.post("/maps", id=MAP, scan_ids=ids)["job_id"])


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.follow", description=__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--rate", type=float, default=200_000, help="bytes a second of each link")
    parser.add_argument("--drops", type=float, default=5.0, help="seconds after which a connection is reset")
    add_common(parser, minutes=10)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
