"""A catalog, a queue, workers with steps of their own (standin.py), and the record of what the steps did."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from redis import Redis

from service.api.http.reading.submission import Ticker
from service.catalog import steps
from service.catalog.catalog import Catalog, open_catalog
from service.catalog.jobs import Jobs
from service.catalog.records import JobRecord
from service.catalog.sql import tables
from service.catalog.sql.tables import now
from service.catalog.steps import JobKind, Queue
from service.dispatch import Dispatcher
from service.queue import JobQueue
from service.settings import Settings
from service.up.launcher import environment_of
from tests.support.processes import until
from tests.support.standin import written_steps

STANDIN = "tests.support.standin"  #: the module of the workers and their steps
ROOT = Path(__file__).parents[2]
KINDS: tuple[JobKind, ...] = ("map", "survey", "model")


class Bench:
    """A catalog, a queue, its workers, and the record of what the steps did; a context manager."""

    def __init__(self, folder: Path, redis_url: str, settings: Settings | None = None) -> None:
        self.folder, self.redis_url, self.redis = folder, redis_url, Redis.from_url(redis_url)
        own = settings or Settings(data_dir=folder / "data", redis_url=redis_url)
        self.settings = own.model_copy(update={"redis_url": redis_url})
        self.catalog = open_catalog(self.settings)
        self.workers: list[subprocess.Popen[bytes]] = []
        self.queue = JobQueue(redis_url)
        self.dispatcher = Dispatcher(self.catalog.jobs, self.queue)
        self._ticker = Ticker(self.dispatcher, every_s=0.1)
        self._real_steps = dict(steps.STEPS)

    def __enter__(self) -> Bench:
        self._ticker.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._ticker.__exit__()
        for worker in self.workers:
            worker.kill()
            worker.wait()
        steps.STEPS.update(self._real_steps)
        self.queue.close()
        self.catalog.close()

    @property
    def jobs(self) -> Jobs:
        """The jobs of the catalog."""
        return self.catalog.jobs

    def job(self, job_id: str) -> JobRecord:
        """The job as clients see it."""
        return self.catalog.jobs.get(job_id)

    def worker(self, queue: str, grace: float = 5, name: str | None = None) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", STANDIN, queue, self.redis_url, str(self.folder), str(grace)]
        environment = {**os.environ, **environment_of(self.settings)}
        process = subprocess.Popen(
            [*command, *([name] if name else [])], env=environment, cwd=ROOT, start_new_session=True
        )
        self.workers.append(process)
        return process

    def submit(
        self, job_id: str, *chain: tuple[str, Queue], timeout_s: int = 60, owner: str | None = None
    ) -> None:
        """Record a job of these steps; each chain of steps that is new takes a kind of job for itself."""
        self.queue._timeout_s = timeout_s
        kind = self._kind(chain)
        with self.catalog.database.write() as session:
            if session.get(tables.Map, "bench") is None:
                session.add(
                    tables.Map(map_id="bench", model="none/1", settings={}, created=now(), updated=now())
                )
                session.flush()
            session.add(
                tables.Job(
                    job_id=job_id,
                    kind=kind,
                    map_id="bench",
                    status="accepted",
                    message="waiting",
                    progress=0,
                    step=chain[0][0],
                    due=now(),
                    created=now(),
                    updated=now(),
                    owner=owner,
                )
            )

    def _kind(self, chain: tuple[tuple[str, Queue], ...]) -> JobKind:
        path = self.folder / "steps.json"
        written: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        listed = [list(step) for step in chain]
        kind = next((kind for kind in KINDS if written.get(kind, listed) == listed), None)
        assert kind is not None, "no more than three chains of steps"
        aside = path.with_suffix(".part")
        aside.write_text(json.dumps({**written, kind: listed}))
        aside.replace(path)
        steps.STEPS.update(written_steps(path))
        return kind

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
        """Let the time be over in which a dead worker's claim still stands."""
        claims = self.claims(queue)
        assert claims
        self.redis.delete(*(f"rq:execution:{claim}" for claim in claims))

    def claims(self, queue: str) -> list[str]:
        """Return the claims that workers have, or had and did not give back."""
        found: Any = self.redis.zrange(f"rq:wip:{queue}", 0, -1)
        return [claim.decode() for claim in found]

    def traces(self, job_id: str) -> list[str]:
        """Return the keys in Redis that name a job."""
        keys: Any = self.redis.keys("rq:*")
        return [key.decode() for key in keys if job_id.encode() in key]


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
