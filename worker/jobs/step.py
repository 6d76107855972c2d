"""What every step has in common: its context, its end, and how its files reach the blob store."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from service import tracing
from service.catalog.catalog import Catalog, open_catalog
from service.catalog.records import JobRecord, Problem
from service.catalog.steps import JobKind
from service.settings import Settings
from worker.errors import Cancelled, PipelineError
from worker.reporting import Reporter

log = logging.getLogger("worker.jobs")

T = TypeVar("T")

#: The part of the whole job that each stage takes, about as `make bench` measures it.
MAP_STAGES = {
    "reading": (0.0, 0.08),
    "registering": (0.08, 0.5),
    "refining": (0.5, 0.75),
    "fusing": (0.75, 0.85),
    "tiling": (0.85, 0.88),
    "saving": (0.88, 0.9),
    "encoding": (0.9, 0.95),
    "calibrating": (0.95, 1.0),
}
SURVEY_STAGES = {
    "registering": (0.0, 0.45),
    "refining": (0.45, 0.5),
    "tiling": (0.5, 0.52),
    "saving": (0.52, 0.55),
    "scoring": (0.55, 0.75),
    "calibrating": (0.75, 0.8),
    "exporting": (0.8, 1.0),
}
MODEL_STAGES = {
    "packing": (0.0, 0.05),
    "training": (0.05, 0.92),
    "calibrating": (0.92, 0.96),
    "encoding": (0.96, 1.0),
}
STAGES: dict[JobKind, dict[str, tuple[float, float]]] = {
    "map": MAP_STAGES,
    "survey": SURVEY_STAGES,
    "model": MODEL_STAGES,
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Context:
    """What a step works with; `scratch` goes with the step."""

    settings: Settings
    catalog: Catalog
    job: JobRecord
    report: Reporter
    scratch: Path


def step(run: Callable[[Context], None]) -> Callable[[str], None]:
    """Open the catalog, skip what has ended, and record what goes wrong before rq hears of it."""

    @functools.wraps(run)
    def call(job_id: str) -> None:
        settings = Settings()
        with tracing.step(job_id, run.__name__), ExitStack() as stack:
            catalog = open_catalog(settings, migrate=False)
            stack.callback(catalog.close)
            if not catalog.jobs.start(job_id):
                log.info("job %s has ended; nothing to do", job_id)
                return
            job = catalog.jobs.get(job_id)
            folder = settings.scratch_dir()  # on the blobs' own disk, and swept when the service starts
            folder.mkdir(parents=True, exist_ok=True)
            scratch = Path(stack.enter_context(TemporaryDirectory(prefix="spicd-step-", dir=folder)))
            report = Reporter(STAGES[job.kind], functools.partial(_report, catalog, job_id))
            try:
                run(Context(settings=settings, catalog=catalog, job=job, report=report, scratch=scratch))
            except Cancelled:
                log.info("job %s was dismissed", job_id)
            except PipelineError as error:
                catalog.jobs.fail(job_id, Problem.of(error))
                raise

    return call


def _report(catalog: Catalog, job_id: str, stage: str, share: float) -> bool:
    tracing.stage(stage)
    return catalog.jobs.report(job_id, message=stage, progress=share)


def load(context: Context, key: str, read: Callable[[Path], T]) -> T:
    """Read a blob with `read`, from a file on this machine. Raises FileNotFoundError."""
    with context.catalog.blobs.local(key) as path:
        return read(path)


def put(context: Context, key: str, write: Callable[[Path], None]) -> None:
    """Have a file written aside, then take it into the blob store in one move."""
    path = context.scratch / key.replace("/", "_")
    write(path)
    context.catalog.blobs.put_file(key, path, move=True)
