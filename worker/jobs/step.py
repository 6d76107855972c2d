"""What every step has in common: its context, its end, and how its files reach the blob store."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from service import tracing
from service.catalog.catalog import Catalog, open_catalog
from service.catalog.jobs import Run
from service.catalog.records import JobRecord, Problem
from service.catalog.steps import STEPS, JobKind, step_of
from service.errors import DatabaseUnavailable, NotFound, Unavailable, is_disk_full
from service.settings import Settings
from worker.errors import Cancelled, GaveWay, NoSpaceLeft, PipelineError
from worker.memory import as_out_of_memory
from worker.reporting import Reporter, Turn
from worker.scratch import scratch_folder

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
    "exporting": (0.9, 0.92),
    "encoding": (0.92, 0.95),
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
    run: Run  #: this one, for the end of the job
    report: Reporter
    give_way: Callable[[], None]  #: called where what was done is kept; may raise GaveWay
    scratch: Path


def step(run: Callable[[Context], None]) -> Callable[[str], None]:
    """Have a step begin, go on to the next when it ends well, and record what went wrong before its worker hears of it.

    A step that is not due does nothing: its job has ended or gone on, or another worker has it.
    """

    @functools.wraps(run)
    def call(job_id: str) -> None:
        settings = Settings()
        with tracing.step(job_id, run.__name__), ExitStack() as stack:
            catalog = open_catalog(settings, migrate=False)
            stack.callback(catalog.close)
            begun = _begun(catalog, job_id, run.__name__)
            if begun is None:
                log.info("%s of job %s is not due; nothing to do", run.__name__, job_id)
                return
            job = catalog.jobs.get(job_id)
            folder = settings.scratch_dir()  # on the blobs' own disk
            try:
                # what the step wrote aside is gone before its end is recorded: on a full disk that needs the space
                with scratch_folder(folder, f"{job_id}-{begun.step}") as scratch:
                    context = _context(settings, catalog, job, begun, scratch)
                    with as_out_of_memory(f"a step of job {job_id}"):
                        run(context)
                catalog.jobs.advance(begun)
            except Exception as error:
                _ended(catalog, begun, error)

    return call


def _begun(catalog: Catalog, job_id: str, function: str) -> Run | None:
    """Begin the step that a function is of a job; None where it is not due."""
    try:
        kind = catalog.jobs.get(job_id).kind
    except NotFound:
        return None
    names = (step.name for step in STEPS[kind] if step.function.rpartition(".")[2] == function)
    return catalog.jobs.begin(job_id, next(names, ""))


def _context(settings: Settings, catalog: Catalog, job: JobRecord, run: Run, scratch: Path) -> Context:
    """Return what a step works with; builds and trainings give way to surveys that wait for the same workers."""
    queue = step_of(job.kind, run.step).queue
    turn = Turn(lambda: job.kind != "survey" and catalog.jobs.surveys_wait(queue))
    report = Reporter(
        STAGES[job.kind],
        functools.partial(_report, catalog, run),
        give_way={"registering": turn.check} if job.kind == "map" else {},
    )
    return Context(
        settings=settings,
        catalog=catalog,
        job=job,
        run=run,
        report=report,
        give_way=turn.check,
        scratch=scratch,
    )


def _report(catalog: Catalog, run: Run, stage: str, share: float) -> bool:
    """Say how far a step is. Where the database does not answer the step goes on; it has to at the step's end."""
    tracing.stage(stage)
    try:
        return catalog.jobs.report(run, message=stage, progress=share)
    except DatabaseUnavailable as error:
        log.warning("job %s: its progress was not recorded: %s", run.job_id, error)
        return True


def _ended(catalog: Catalog, run: Run, error: Exception) -> None:
    """Record an error that ended a step; raises it where the worker shall hear of it too."""
    of = (run.job_id, run.step)
    match error:
        case GaveWay():
            log.info("job %s gives way to a survey", run.job_id)
            catalog.jobs.put_back(*of, "gave way to a survey; goes on after it", begun=run.begun)
        case Cancelled():
            log.info("job %s was dismissed, or another worker has it", run.job_id)
        case Unavailable():
            log.warning("step %s of job %s is interrupted: %s", run.step, run.job_id, error)
            catalog.jobs.interrupt(*of, str(error), begun=run.begun)
        case PipelineError():
            catalog.jobs.fail(run.job_id, Problem.of(error), step=run.step, begun=run.begun)
            raise error
        case _ if is_disk_full(error):
            full = NoSpaceLeft("the disk is full; make room, then run it again")
            catalog.jobs.fail(run.job_id, Problem.of(full), step=run.step, begun=run.begun)
            raise full from error
        case _:
            raise error


def load(context: Context, key: str, read: Callable[[Path], T]) -> T:
    """Read a blob with `read`, from a file on this machine. Raises FileNotFoundError."""
    with context.catalog.blobs.local(key) as path:
        return read(path)


def put(context: Context, key: str, write: Callable[[Path], None]) -> None:
    """Have a file written aside, then take it into the blob store in one move."""
    path = context.scratch / key.replace("/", "_")
    write(path)
    context.catalog.blobs.put_file(key, path, move=True)
