"""A worker with steps of its own, for tests.

    python -m tests.support.standin geometry|inference REDIS_URL FOLDER [GRACE [NAME]]

What the steps did and how they ended stands in FOLDER/record, one line an event; FOLDER/steps.json says of which steps
each kind of job consists. The catalog is that of FOLDER/data.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from redis import Redis

from service.catalog import steps
from service.logs import set_up_logging
from service.settings import Settings
from service.up.lifetime import end_with_parent
from worker.__main__ import CatalogRecords, work
from worker.errors import RegistrationFailed
from worker.jobs.step import Context, step
from worker.rq_workers import GeometryWorker, InferenceWorker
from worker.scratch import shared_temporary

FUNCTIONS = (
    "first", "second", "third", "refuse", "crash", "crash_once", "sleep", "busy", "hold", "finish", "stray", "full",
    "early", "deaf", "faulty_once",
)  # fmt: skip


def record(*words: str) -> None:
    """Append one line; the write is one system call, so that processes do not mix."""
    with Path(os.environ["STANDIN_RECORD"]).open("a") as file:
        file.write(" ".join(words) + "\n")


def written_steps(path: Path) -> dict[steps.JobKind, tuple[steps.Step, ...]]:
    """Return the steps of each kind of job, as the bench wrote them."""
    table = json.loads(path.read_text()) if path.exists() else {}
    return {
        kind: tuple(
            steps.Step(name=name, function=f"tests.support.standin.{name}", queue=queue)
            for name, queue in chain
        )
        for kind, chain in table.items()
    }


def refresh() -> None:
    """Read anew of which steps jobs consist."""
    steps.STEPS.update(written_steps(Path(os.environ["STANDIN_RECORD"]).with_name("steps.json")))


def stage(run: Callable[[Context], None]) -> Callable[[str], None]:
    """Make a step of a function, as the steps of the service are made."""
    run.__name__ = run.__name__.lstrip("_")
    shell = step(run)

    @functools.wraps(run)
    def call(job_id: str) -> None:
        refresh()
        shell(job_id)

    return call


@stage
def first(context: Context) -> None:
    record("first", context.job.job_id)


@stage
def second(context: Context) -> None:
    record("second", context.job.job_id)


@stage
def third(context: Context) -> None:
    record("third", context.job.job_id)


@stage
def refuse(context: Context) -> None:
    raise RegistrationFailed("scan 1: fitness 0.10 is below 0.30")


@stage
def full(context: Context) -> None:
    raise OSError(28, "No space left on device")


@stage
def crash(context: Context) -> None:
    """End as a fault in C++ ends a process."""
    record("crash", context.job.job_id)
    os.abort()


@stage
def crash_once(context: Context) -> None:
    """End so, but for the second time."""
    record("crash_once", context.job.job_id)
    mark = Path(os.environ["STANDIN_RECORD"]).with_name(f"crashed-{context.job.job_id}")
    if not mark.exists():
        mark.touch()
        os.abort()


@stage
def _early(context: Context) -> None:
    record("early", context.job.job_id)


def early(job_id: str) -> None:
    """End after the worker claimed the step and before it began, once."""
    mark = Path(os.environ["STANDIN_RECORD"]).with_name("early")
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), 9)
    _early(job_id)


@stage
def sleep(context: Context) -> None:
    """Hold still in one call, as native code does."""
    record("sleep", context.job.job_id, str(os.getpid()))
    time.sleep(60)
    record("woke", context.job.job_id)


@stage
def deaf(context: Context) -> None:
    """Go on whatever is raised, as code does that catches too much."""
    record("deaf", context.job.job_id, str(os.getpid()))
    while True:
        try:
            time.sleep(60)
        except Exception:  # noqa: S112 - that is the fault
            continue


@stage
def faulty_once(context: Context) -> None:
    """Meet one that fails when the test says so, and works in the next process."""
    record("faulty_once", context.job.job_id, str(os.getpid()))
    folder = Path(os.environ["STANDIN_RECORD"]).parent
    if not (folder / "failed").exists():
        while not (folder / "fail").exists():
            time.sleep(0.02)
        (folder / "failed").touch()
        raise RuntimeError("CUDA error: an illegal memory access was encountered\nand what else torch says")


@stage
def busy(context: Context) -> None:
    """Work in small pieces, as batches of the network do."""
    record("busy", context.job.job_id, str(os.getpid()))
    for _ in range(600):
        time.sleep(0.1)


@stage
def hold(context: Context) -> None:
    """Work until the test says `go`, and leave files that nobody else removes."""
    (context.scratch / "half").write_text("half of a file")
    record("hold", context.job.job_id, str(os.getpid()))
    while not Path(os.environ["STANDIN_RECORD"]).with_name("go").exists():
        time.sleep(0.02)
    record("held", context.job.job_id)


@stage
def finish(context: Context) -> None:
    """The last step of a job."""
    record("finish", context.job.job_id)
    context.catalog.jobs.succeed(context.job.job_id, run=context.run)


@stage
def stray(context: Context) -> None:
    """Start a process that outlives the step."""
    pid = subprocess.Popen(["/bin/sleep", "60"]).pid
    record("stray", context.job.job_id, str(pid))


def leak(*_: object) -> None:
    """What nobody may call."""
    record("leak")


class Book(CatalogRecords):
    """Tells the catalog, and the record."""

    def failed(self, job_id: str, step: str, code: str, sentence: str) -> None:
        record("died", job_id, code, sentence)
        super().failed(job_id, step, code, sentence)

    def lost(self, job_id: str, step: str, how: str) -> None:
        record("lost", job_id, how)
        super().lost(job_id, step, how)

    def interrupted(self, job_id: str, step: str, how: str) -> None:
        record("interrupted", job_id, how)
        super().interrupted(job_id, step, how)

    def stopped(self, job_id: str, step: str) -> None:
        record("stopped", job_id)
        super().stopped(job_id, step)

    def tick(self) -> None:
        refresh()
        super().tick()


def main() -> None:
    queue, redis_url, folder, grace, *name = [*sys.argv[1:], *(["5"] if len(sys.argv) == 4 else [])]
    os.environ["STANDIN_RECORD"] = str(Path(folder) / "record")
    os.environ["SPICD_REDIS_URL"] = redis_url
    end_with_parent(os.getppid())
    set_up_logging("info")
    logging.getLogger("worker").info("up")
    refresh()
    settings = Settings()
    concurrency = settings.inference_concurrency or 1
    common: dict[str, Any] = {
        "allowed": frozenset(f"tests.support.standin.{function}" for function in FUNCTIONS),
        "records": Book(settings),
        "grace_s": float(grace),
        "name": name[0] if name else None,
    }

    def make() -> GeometryWorker | InferenceWorker:
        redis = Redis.from_url(redis_url)
        if queue == "geometry":
            return GeometryWorker(queue, redis, **common)
        return InferenceWorker(queue, redis, concurrency=concurrency, **common)

    several = queue == "inference" and concurrency > 1
    with shared_temporary(settings.scratch_dir(), "standin") if several else contextlib.nullcontext():
        work(make)
    record("ended", queue)


if __name__ == "__main__":
    main()
