"""A worker with steps of its own, for tests.

    python -m tests.support.standin geometry|inference REDIS_URL FOLDER [GRACE]

What the steps did and how they ended stands in FOLDER/record, one line an event. Where STANDIN_CATALOG names a
database, the steps begin and end their job there, and the worker tells it what it tells the catalog.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from pathlib import Path

from redis import Redis

from service.catalog.database import Database
from service.catalog.jobs import Jobs
from service.logs import set_up_logging
from service.up.lifetime import end_with_parent
from worker.__main__ import CatalogRecords
from worker.errors import RegistrationFailed
from worker.rq_workers import GeometryWorker, InferenceWorker

FUNCTIONS = ("first", "second", "third", "refuse", "crash", "sleep", "busy", "hold", "finish")
MAX_LOST = 3


def record(*words: str) -> None:
    """Append one line; the write is one system call, so that processes do not mix."""
    with Path(os.environ["STANDIN_RECORD"]).open("a") as file:
        file.write(" ".join(words) + "\n")


def first(job_id: str) -> None:
    record("first", job_id)


def second(job_id: str) -> None:
    record("second", job_id)


def third(job_id: str) -> None:
    record("third", job_id)


def refuse(job_id: str) -> None:
    raise RegistrationFailed("scan 1: fitness 0.10 is below 0.30")


def crash(job_id: str) -> None:
    """End as a fault in C++ ends a process."""
    record("crash", job_id)
    os.abort()


def sleep(job_id: str) -> None:
    """Hold still in one call, as native code does."""
    record("sleep", job_id, str(os.getpid()))
    time.sleep(60)
    record("woke", job_id)


def busy(job_id: str) -> None:
    """Work in small pieces, as batches of the network do."""
    record("busy", job_id, str(os.getpid()))
    for _ in range(600):
        time.sleep(0.1)


def hold(job_id: str) -> None:
    """Work until the test says `go`."""
    if catalog := os.environ.get("STANDIN_CATALOG"):
        Jobs(Database(catalog)).start(job_id)
    record("hold", job_id, str(os.getpid()))
    while not Path(os.environ["STANDIN_RECORD"]).with_name("go").exists():
        time.sleep(0.02)
    record("held", job_id)


def finish(job_id: str) -> None:
    """The last step of a job in the catalog."""
    record("finish", job_id)
    Jobs(Database(os.environ["STANDIN_CATALOG"])).succeed(job_id)


def leak(*_: object) -> None:
    """What nobody may call."""
    record("leak")


class Book:
    """Stands in for the catalog: every job is there and open, and is given up at the third loss."""

    def failed(self, job_id: str, code: str, sentence: str) -> None:
        record("died", job_id, code, sentence)

    def lost(self, job_id: str, how: str) -> bool:
        record("lost", job_id, how)
        lines = Path(os.environ["STANDIN_RECORD"]).read_text().splitlines()
        return sum(line.startswith(f"lost {job_id} ") for line in lines) < MAX_LOST

    def stopped(self, job_id: str) -> bool:
        record("stopped", job_id)
        return True


def main() -> None:
    queue, redis_url, folder, grace = [*sys.argv[1:], "5"][:4]
    os.environ["STANDIN_RECORD"] = str(Path(folder) / "record")
    end_with_parent(os.getppid())
    set_up_logging("info")
    logging.getLogger("worker").info("up")
    kind = GeometryWorker if queue == "geometry" else InferenceWorker
    kind(
        queue,
        Redis.from_url(redis_url),
        allowed=frozenset(f"tests.support.standin.{name}" for name in FUNCTIONS),
        records=CatalogRecords(catalog) if (catalog := os.environ.get("STANDIN_CATALOG")) else Book(),
        grace_s=float(grace),
    ).work()
    record("ended", queue)


if __name__ == "__main__":
    main()
