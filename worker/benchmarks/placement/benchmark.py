"""`spicd-worker evaluate placement`: trials made and answered, or found, and figures taken of them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from worker.benchmarks.documents import Document
from worker.benchmarks.placement.answers import PROCESSES, answers_of
from worker.benchmarks.placement.measures import Answered, document
from worker.benchmarks.placement.pictures import draw_impostors
from worker.benchmarks.placement.plan import FIRST_SEED, KINDS, Kind, Part, PlacementSettings, trials
from worker.benchmarks.placement.real import evaluate_real
from worker.benchmarks.placement.report import draw
from worker.benchmarks.timing import machine
from worker.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True, slots=True)
class PlacementBenchmarkSettings:
    """What is run."""

    out: Path  #: folder of the maps and answers, which are kept, and of the pictures
    part: Part = "figures"
    only: tuple[Kind, ...] = KINDS
    trials: int | None = None  #: of each row of the table at most; None: all
    all_impostors: bool = False  #: whatever `trials` says
    processes: int = PROCESSES
    real: Path | None = None  #: folder of real scans
    pictures: int = 0  #: of impostors, at most
    made: PlacementSettings = field(default_factory=PlacementSettings)


def evaluate(settings: PlacementBenchmarkSettings, progress: Progress = no_progress) -> Document:
    """Run all of it, and draw what is to be drawn; JSON-ready. Raises MapFailed, and OSError for the folders."""
    answered = run(settings, progress)
    result: Document = {
        "machine": machine(load=os.getloadavg()[0]),
        "settings": settings.made.model_dump(mode="json"),
        "part": settings.part,
        "first_seed": FIRST_SEED[settings.part],
        **document(answered),
    }
    if settings.real is not None:
        result["real"] = evaluate_real(
            settings.real,
            settings.made.pipeline,
            settings.out,
            processes=settings.processes,
            progress=progress,
        )
    if settings.pictures:
        progress("drawing", 0.0)
        result["pictures"] = draw_impostors(answered, settings.made, settings.out, settings.pictures)
    draw(settings.out, result)
    return result


def run(settings: PlacementBenchmarkSettings, progress: Progress = no_progress) -> tuple[Answered, ...]:
    """Answer the trials, or find their answers. Raises as `evaluate` does."""
    planned = trials(
        settings.made,
        settings.part,
        only=settings.only,
        most=settings.trials,
        all_impostors=settings.all_impostors,
    )
    said = answers_of(planned, settings.made, settings.out, processes=settings.processes, progress=progress)
    return tuple(Answered(trial=trial, answer=answer) for trial, answer in zip(planned, said, strict=True))
