"""A worker with steps of its own, for tests: `python standin.py geometry|inference REDIS_URL FOLDER [GRACE]`.

What the steps did and how they ended stands in FOLDER/record, one line an event.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from pathlib import Path

from redis import Redis

from service.lifetime import end_with_parent
from service.logs import set_up_logging
from worker.errors import RegistrationFailed
from worker.rq_workers import GeometryWorker, InferenceWorker

FUNCTIONS = ("first", "second", "third", "refuse", "crash", "sleep", "busy")


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


def leak(*_: object) -> None:
    """What nobody may call."""
    record("leak")


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
        allowed=frozenset(f"standin.{name}" for name in FUNCTIONS),
        on_death=lambda job_id, code, sentence: record("died", job_id, code, sentence),
        grace_s=float(grace),
    ).work()
    record("ended", queue)


if __name__ == "__main__":
    main()
