"""Kills and freezes the parts of a service of its own while surveys run: `python -m tests.breaking.chaos`.

Every few seconds something ends (SIGKILL) or stands still (SIGSTOP): the process of a step, a worker, a worker in the
moment in which it takes a step, Redis, the whole service; or somebody holds the database's lock. Exit status 1 where a
survey that was accepted did not end, ended otherwise than without any of it, or is there twice; where something is left
behind; or where what a worker had begun took longer than 10 s (median) to be begun again.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sqlite3
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
from redis import Redis
from redis.exceptions import RedisError
from rich.progress import Progress

from tests.support.findings import Deadline, Findings, add_common, show
from tests.support.processes import descendants, running
from tests.support.running_service import ROOT, Service
from tests.support.traffic import Room, Upload, send_scan

MAP = "chaos"
TARGET_S = 10.0  #: median time until what was lost is begun again
_GONE_S = 90.0  #: a step that was not begun again by then counts with this time
_SETTLE_S = 300.0  #: after the last kill, for what is open to end

#: What is done, and how often among the others.
KILLS = {"step": 5, "geometry": 3, "inference": 3, "hand-over": 3, "redis": 2, "service": 1, "database": 2}
FREEZES = {"step": 3, "geometry": 2, "inference": 2, "redis": 1, "service": 1}


@dataclass
class Site:
    """The service under test, and how to find its parts."""

    folder: Path
    room: Room
    service: Service

    @property
    def data(self) -> Path:
        return self.folder / "data"

    def children(self, queue: str) -> list[int]:
        """The workers of a queue."""
        return [
            pid
            for pid in descendants(self.service.process.pid)
            if _words(pid)[1:4] == ["-m", "worker", queue]
        ]

    def workers(self, queue: str) -> list[int]:
        """The workers of a queue, less the steps that they forked."""
        return [pid for pid in self.children(queue) if _parent(pid) == self.service.process.pid]

    def steps(self) -> list[int]:
        """The processes of steps."""
        return [pid for pid in self.children("geometry") if _parent(pid) != self.service.process.pid]

    def redis(self) -> list[int]:
        """The embedded server."""
        servers = ("redis-server", "valkey-server")
        return [pid for pid in descendants(self.service.process.pid) if _words(pid)[0].endswith(servers)]

    def client(self) -> Redis:
        return Redis(unix_socket_path=str(self.data / "redis" / "redis.sock"), socket_timeout=2)

    def query(self, statement: str) -> list[tuple[Any, ...]]:
        """Ask the database."""
        with closing(sqlite3.connect(f"file:{self.data}/spicd.sqlite?mode=ro", uri=True, timeout=20)) as base:
            return base.execute(statement).fetchall()


@dataclass
class Run:
    """What was done, and what came of it."""

    site: Site
    rng: random.Random
    findings: Findings = field(default_factory=Findings)
    done: Counter[str] = field(default_factory=Counter)  #: kills and freezes by where
    recovery_s: dict[str, list[float]] = field(default_factory=dict)
    submitted: dict[str, int] = field(default_factory=dict)  #: survey -> number of its upload
    expected: dict[int, Any] = field(
        default_factory=dict
    )  #: number of an upload -> what its survey has to say
    over: threading.Event = field(default_factory=threading.Event)
    watchers: list[threading.Thread] = field(default_factory=list)


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    with tempfile.TemporaryDirectory(prefix="chaos-") as folder:
        site = Site(
            Path(folder), Room(map_scans=2, views=2, scan_s=1.0), started(Path(folder), options.workers)
        )
        run = Run(site, random.Random(options.seed))
        try:
            prepare(run, options.views)
            deadline = Deadline(options.minutes)
            with surveys_submitted(run, options):
                break_things(run, options, deadline)
            settle(run)
            check(run)
            passed = deadline.passed_s()
        except BaseException:
            print(site.service.log.read_text()[-6000:], file=sys.stderr)
            raise
        finally:
            with suppress(Exception):
                site.service.process.kill()
                site.service.process.wait()
        if options.log is not None:
            options.log.write_bytes(site.service.log.read_bytes())
    rows, document = report(run, options, passed)
    show(rows, document, options.json)
    return 1 if run.findings.counts else 0


def started(folder: Path, workers: int) -> Service:
    """Start the service on a folder, for the first time or again."""
    (folder / "ready.json").unlink(missing_ok=True)
    (folder / "tmp").mkdir(exist_ok=True)
    settings = {"geometry_workers": workers, "min_free_bytes": 0}
    return Service(folder, ROOT / "model_store", **settings, TMPDIR=str(folder / "tmp"))


def prepare(run: Run, views: int) -> None:
    """Build the map, and learn what a survey of each upload says when nothing is broken."""
    service, room = run.site.service, run.site.room
    ids = [_sent(service.http, upload) for upload in room.map_uploads()]
    service.succeeded(service.post("/maps", id=MAP, scan_ids=ids)["job_id"])
    for number in range(views):
        survey = _submitted(service.http, room.survey_upload(number))
        service.succeeded(survey["job_id"])
        run.expected[number] = said(service.http, survey["survey_id"])


def said(http: httpx.Client, survey_id: str) -> Any:
    """Return what has to be the same, however often the steps of a survey were run."""
    survey = http.get(f"/surveys/{survey_id}").json()
    features = http.get(f"/surveys/{survey_id}/tiles").json()["features"]
    tiles = sorted((tile["properties"]["tile_id"], tile["properties"]["state"]) for tile in features)
    return survey["status"], survey["counts"], survey["objects"], tiles


@contextmanager
def surveys_submitted(run: Run, options: argparse.Namespace) -> Iterator[None]:
    """Keep so many surveys open at once while the block runs."""
    thread = threading.Thread(target=_submit, args=(run, options.open, options.views), daemon=True)
    thread.start()
    yield
    run.over.set()
    thread.join(60)


def _submit(run: Run, most: int, views: int) -> None:
    number = 0
    while not run.over.wait(0.2):
        try:
            with httpx.Client(base_url=run.site.service.url, timeout=10) as http:
                jobs = http.get("/jobs", params={"status": "accepted"}).json()["jobs"]
                jobs += http.get("/jobs", params={"status": "running"}).json()["jobs"]
                if len(jobs) < most:
                    survey = _submitted(http, run.site.room.survey_upload(number % views))
                    run.submitted[survey["survey_id"]] = number % views
                    number += 1
        except (httpx.HTTPError, KeyError, ValueError):  # it is just being broken; nothing was accepted
            continue


def break_things(run: Run, options: argparse.Namespace, deadline: Deadline) -> None:
    """Kill and freeze, at random, until all is done or time is over."""
    plan = [("kill", where) for where in _drawn(run.rng, KILLS, options.kills)]
    plan += [("freeze", where) for where in _drawn(run.rng, FREEZES, options.freezes)]
    run.rng.shuffle(plan)
    with Progress() as bar:
        task = bar.add_task("breaking", total=len(plan))
        for how, where in plan:
            if deadline.over():
                return
            time.sleep(run.rng.uniform(0.3, 2 * options.every - 0.3))
            with suppress(OSError, RedisError, sqlite3.Error):
                if _break(run, how, where):
                    run.done[f"{how} {where}"] += 1
            bar.advance(task)


def _break(run: Run, how: str, where: str) -> bool:
    """Do one thing; False where there was nothing to do it to."""
    site, rng = run.site, run.rng
    if where == "database":
        threading.Thread(target=_lock_database, args=(site, rng.uniform(1, 6)), daemon=True).start()
        return True
    if where == "hand-over":
        return _kill_at_hand_over(run)
    find: dict[str, Callable[[], list[int]]] = {
        "step": site.steps,
        "geometry": lambda: site.workers("geometry"),
        "inference": lambda: site.workers("inference"),
        "redis": site.redis,
        "service": lambda: [site.service.process.pid],
    }
    pids = find[where]()
    if not pids:
        return False
    pid = rng.choice(pids)
    _watch_recovery(run, f"{how} {where}")
    if how == "kill":
        os.kill(pid, signal.SIGKILL)
        if where == "service":
            site.service.process.wait()
            site.service = started(site.folder, len(site.workers("geometry")) or 1)
        return True
    os.kill(pid, signal.SIGSTOP)
    thaw = (
        rng.uniform(2, 6) if where == "service" else 40.0
    )  # who supervises it has nobody who supervises him
    threading.Thread(target=_thaw, args=(pid, thaw), daemon=True).start()
    return True


def _kill_at_hand_over(run: Run) -> bool:
    """Kill a geometry worker when it has taken a step out of the queue and not yet begun it."""
    workers = run.site.workers("geometry")
    until = time.monotonic() + 3
    with closing(run.site.client()) as client:
        while time.monotonic() < until:
            if client.llen("rq:queue:geometry:intermediate"):
                for pid in workers:
                    os.kill(pid, signal.SIGKILL)
                return True
    return False


def _lock_database(site: Site, seconds: float) -> None:
    path = site.data / "spicd.sqlite"
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=20, isolation_level=None)) as base:
        base.execute("BEGIN IMMEDIATE")
        time.sleep(seconds)
        base.execute("ROLLBACK")


def _thaw(pid: int, after_s: float) -> None:
    time.sleep(after_s)
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def _watch_recovery(run: Run, what: str) -> None:
    """Note how long it takes until each step that a worker has begun is begun again, or over."""
    try:
        begun = run.site.query("SELECT id, step, begun FROM jobs WHERE begun IS NOT NULL")
    except sqlite3.Error:
        return
    since = time.monotonic()

    def watch() -> None:
        left = set(begun)
        while left and time.monotonic() - since < _GONE_S:
            time.sleep(0.1)
            with suppress(sqlite3.Error):
                waits = set(run.site.query("SELECT id FROM jobs WHERE begun IS NULL AND finished IS NULL"))
                now = set(run.site.query("SELECT id, step, begun FROM jobs WHERE begun IS NOT NULL"))
                moved = {one for one in left if one not in now and (one[0],) not in waits}
                for _ in moved:
                    run.recovery_s.setdefault(what, []).append(time.monotonic() - since)
                left -= moved
        for _ in left:
            run.recovery_s.setdefault(what, []).append(_GONE_S)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    run.watchers.append(thread)


def settle(run: Run) -> None:
    """Wait until every job has ended, and every process that was stopped has gone on or gone."""
    until = time.monotonic() + _SETTLE_S
    while time.monotonic() < until:
        with suppress(sqlite3.Error):
            if not run.site.query("SELECT id FROM jobs WHERE status IN ('accepted', 'running')"):
                break
        time.sleep(0.5)
    for thread in run.watchers:
        thread.join(_GONE_S)


def check(run: Run) -> None:
    """Hold every survey against what it has to say, and look for what was left behind."""
    site, findings = run.site, run.findings
    rows = site.query(
        "SELECT surveys.id, jobs.status, jobs.problem FROM surveys JOIN jobs ON jobs.id = surveys.job_id"
    )
    status = {survey: (state, problem) for survey, state, problem in rows}
    with httpx.Client(base_url=site.service.url, timeout=60) as http:
        for survey, number in run.submitted.items():
            findings.cases += 1
            state, problem = status.get(survey, ("missing", None))
            findings.outcomes[state] += 1
            if state in ("accepted", "running", "missing"):
                findings.add("lost", f"{survey}: {state}")
            elif state != "successful":
                findings.add("failed", f"{survey}: {problem}")
            elif (says := said(http, survey)) != run.expected[number]:
                findings.add("wrong", f"{survey}: {_difference(run.expected[number], says)}")
    unheard = len(status) - len(run.submitted) - len(run.expected)
    findings.outcomes["of a request whose answer was lost"] += unheard
    _check_rests(run)


def _difference(expected: Any, says: Any) -> str:
    """Say in what a survey's answer is another than that of the same scan when nothing was broken."""
    before, now = dict(expected[3]), dict(says[3])
    tiles = [f"{tile} {before.get(tile)} -> {now.get(tile)}" for tile in before.keys() | now.keys()]
    other = [tile for tile in tiles if len({*tile.split()[1::2]}) == 2]
    return f"{expected[:3]} -> {says[:3]}; {', '.join(other[:5])}"


def _check_rests(run: Run) -> None:
    site, findings = run.site, run.findings
    until = time.monotonic() + 30
    while (rests := [*_rests_in_redis(site), *_rests_on_disk(site)]) and time.monotonic() < until:
        time.sleep(1)
    site.service.end()
    for rest in rests:
        findings.add("left behind", rest)
    for path in (site.folder / "tmp").iterdir():
        findings.add("left behind", str(path))


def _rests_in_redis(site: Site) -> list[str]:
    kept = ("rq:workers", "rq:worker:", "rq:queues", "rq:clean_registries")
    with closing(site.client()) as client:
        keys = [key.decode() for key in client.scan_iter("*")]
    return [f"Redis: {key}" for key in keys if not key.startswith(kept)]


def _rests_on_disk(site: Site) -> list[str]:
    folders = (site.data / "scratch", site.data / "incoming")
    return [str(path) for folder in folders if folder.is_dir() for path in folder.iterdir()]


def report(run: Run, options: argparse.Namespace, seconds: float) -> tuple[dict[str, object], dict[str, Any]]:
    """Return the rows of the table, and all of it as JSON has it; notes a recovery that is too slow."""
    every = [value for values in run.recovery_s.values() for value in values]
    median = statistics.median(every) if every else 0.0
    if median > TARGET_S:
        run.findings.add("slow recovery", f"{median:.1f} s in the median")
    rows: dict[str, object] = {
        "kills": sum(n for what, n in run.done.items() if what.startswith("kill")),
        "freezes": sum(n for what, n in run.done.items() if what.startswith("freeze")),
        "minutes": f"{seconds / 60:.0f}",
        "surveys": f"{run.findings.cases}: "
        + ", ".join(f"{count} {state}" for state, count in run.findings.outcomes.items()),
        "recovery": f"{median:.1f} s (median of {len(every)}), "
        f"90%: {sorted(every)[int(0.9 * len(every))] if every else 0:.1f} s, at most {max(every, default=0):.1f} s",
    }
    for what, values in sorted(run.recovery_s.items()):
        rows[f"  {what}"] = (
            f"{run.done[what]} times, {statistics.median(values):.1f} s (median), at most {max(values):.1f} s"
        )
    for what in sorted(set(run.done) - set(run.recovery_s)):
        rows[f"  {what}"] = f"{run.done[what]} times"
    rows["findings"] = dict(run.findings.counts) or "none"
    for kind, words in run.findings.kept.items():
        rows[f"  {kind}"] = "; ".join(words)
    done = {"done": dict(run.done), "recovery_s": run.recovery_s, "seconds": seconds, "seed": options.seed}
    return rows, run.findings.document(**done)


def _drawn(rng: random.Random, weights: dict[str, int], count: int) -> list[str]:
    return rng.choices(list(weights), list(weights.values()), k=count)


def _sent(http: httpx.Client, upload: Upload) -> str:
    answer = send_scan(http, upload)
    answer.raise_for_status()
    return str(answer.json()["scan_id"])


def _submitted(http: httpx.Client, upload: Upload) -> dict[str, Any]:
    answer = http.post(f"/maps/{MAP}/surveys", json={"scan_ids": [_sent(http, upload)]})
    answer.raise_for_status()
    survey: dict[str, Any] = answer.json()
    return survey


def _words(pid: int) -> list[str]:
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode("latin-1").rstrip("\0").split("\0")
        return [*words, "", "", "", ""] if running(pid) else ["", "", "", ""]
    return ["", "", "", ""]


def _parent(pid: int) -> int:
    with suppress(OSError):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return 0


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.chaos", description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--freezes", type=int, default=100)
    parser.add_argument("--every", type=float, default=2.5, help="seconds between two of them, in the mean")
    parser.add_argument("--open", type=int, default=3, help="surveys that are open at once")
    parser.add_argument("--views", type=int, default=2, help="different scans that are sent")
    parser.add_argument("--workers", type=int, default=1, help="of the geometry queue")
    parser.add_argument("--log", type=Path, metavar="FILE", help="keep the service's log there")
    add_common(parser, minutes=90)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
