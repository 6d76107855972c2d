"""A queue, workers with steps of their own (standin.py), and the record of what the steps did."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from redis import Redis

from service.catalog.catalog import Catalog
from service.catalog.steps import Step
from service.queue import JobQueue

STANDIN = Path(__file__).parent / "standin.py"
ROOT = Path(__file__).parents[2]


def until(condition: Callable[[], object], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


class Bench:
    """A queue, its workers, and the record of what the steps did."""

    def __init__(self, folder: Path, redis_url: str, catalog_url: str = "") -> None:
        self.folder, self.redis_url, self.redis = folder, redis_url, Redis.from_url(redis_url)
        self.catalog_url = catalog_url
        self.workers: list[subprocess.Popen[bytes]] = []

    def worker(self, queue: str, grace: float = 5) -> subprocess.Popen[bytes]:
        command = [sys.executable, str(STANDIN), queue, self.redis_url, str(self.folder), str(grace)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "STANDIN_CATALOG": self.catalog_url}
        self.workers.append(subprocess.Popen(command, env=environment, cwd=ROOT, start_new_session=True))
        return self.workers[-1]

    def submit(self, job_id: str, *steps: tuple[str, str], timeout_s: int = 60) -> JobQueue:
        queue = self.queue(*steps, timeout_s=timeout_s)
        queue.submit(job_id, "map")
        return queue

    def queue(self, *steps: tuple[str, str], timeout_s: int = 60) -> JobQueue:
        table = tuple(Step(name=name, function=f"standin.{name}", queue=queue) for name, queue in steps)
        return JobQueue(self.redis_url, timeout_s=timeout_s, steps={"map": table})

    def record(self) -> list[str]:
        path = self.folder / "record"
        return path.read_text().splitlines() if path.exists() else []

    def wait_for(self, start: str) -> list[str]:
        until(lambda: any(line.startswith(start) for line in self.record()))
        return next(line for line in self.record() if line.startswith(start)).split()

    def lines(self, start: str) -> list[str]:
        """The lines of the record that start so."""
        return [line for line in self.record() if line.startswith(start)]

    def names(self) -> list[str]:
        """The first word of each line of the record."""
        return [line.split()[0] for line in self.record()]

    def end_claims(self, queue: str) -> None:
        """As if the minute were over in which a dead worker's claim still stands."""
        claims = self.redis.zrange(f"rq:wip:{queue}", 0, -1)
        assert claims
        self.redis.zadd(f"rq:wip:{queue}", dict.fromkeys(claims, 1))


def add_map(catalog: Catalog, map_id: str = "lobby") -> str:
    """A map of one scan that waits to be built; its job's id."""
    content = b"ply\nend_header\n"
    path = Path(catalog.blobs._root or ".") / "scan.part"
    path.write_bytes(content)
    scan, _ = catalog.scans.add(
        path,
        filename="hall.ply",
        format="ply",
        size=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
    )
    return catalog.maps.create(scan_ids=[scan.scan_id], model="spicd-net/1", map_id=map_id)[1].job_id
