"""A queue, workers with steps of their own (standin.py), the record of what the steps did, and a map's job."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from redis import Redis

from service.catalog.catalog import Catalog
from service.catalog.steps import Queue, Step
from service.queue import JobQueue
from tests.support.processes import until

STANDIN = "tests.support.standin"  #: the module of the workers and their steps
ROOT = Path(__file__).parents[2]


class Bench:
    """A queue, its workers, and the record of what the steps did."""

    def __init__(self, folder: Path, redis_url: str, catalog_url: str = "") -> None:
        self.folder, self.redis_url, self.redis = folder, redis_url, Redis.from_url(redis_url)
        self.catalog_url = catalog_url
        self.workers: list[subprocess.Popen[bytes]] = []

    def worker(self, queue: str, grace: float = 5) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", STANDIN, queue, self.redis_url, str(self.folder), str(grace)]
        environment = {**os.environ, "STANDIN_CATALOG": self.catalog_url}
        self.workers.append(subprocess.Popen(command, env=environment, cwd=ROOT, start_new_session=True))
        return self.workers[-1]

    def submit(self, job_id: str, *steps: tuple[str, Queue], timeout_s: int = 60) -> JobQueue:
        queue = self.queue(*steps, timeout_s=timeout_s)
        queue.submit(job_id, "map")
        return queue

    def queue(self, *steps: tuple[str, Queue], timeout_s: int = 60) -> JobQueue:
        table = tuple(Step(name=name, function=f"{STANDIN}.{name}", queue=queue) for name, queue in steps)
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
        """Let the minute be over in which a dead worker's claim still stands."""
        claims = self.claims(queue)
        assert claims
        self.redis.zadd(f"rq:wip:{queue}", dict.fromkeys(claims, 1))

    def claims(self, queue: str) -> dict[str, float]:
        """Return the steps that a worker has a claim on, and when (seconds) each claim ends."""
        claims: Any = self.redis.zrange(f"rq:wip:{queue}", 0, -1, withscores=True)
        return {claim.decode(): end for claim, end in claims}


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
