"""`spicd-worker evaluate registration`: every scenario of every seed, and what stands beside it."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from worker.benchmarks.registration import plain
from worker.benchmarks.registration.assessment import Assessment, assess
from worker.benchmarks.registration.comparison import compare
from worker.benchmarks.registration.picture import draw_run
from worker.benchmarks.registration.real import evaluate_real
from worker.benchmarks.registration.scenario import (
    KINDS,
    Kind,
    Scenario,
    WalkSettings,
    scenario,
    take_walk,
)
from worker.benchmarks.registration.stage_clock import StageClock, processor_seconds
from worker.benchmarks.registration.survey import time_survey
from worker.cloud.types import Matrix4
from worker.pipeline.flow import BuiltMap, build_map
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

#: Table 2 of the paper; Section 3.3.2 for the share of ICP calls that are saved ("over 80%")
PAPER = {
    "scans": 42,
    "accepted": 25,
    "mean_rmse": 0.0250,
    "std_rmse": 0.0045,
    "mean_fitness": 0.592,
    "std_fitness": 0.089,
    "calls_saved": 0.80,
}


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchmarkSettings:
    """What is run."""

    walk: WalkSettings = field(default_factory=WalkSettings)  #: its seed gives way to each of `seeds`
    seeds: tuple[int, ...] = (1,)
    kinds: tuple[Kind, ...] = KINDS
    plain: bool = False  #: the plain way too, on the drifted scans of the first seed
    plain_pairs: int | None = None  #: so many random pairs instead of all, and the seconds extrapolated
    survey: bool = True  #: time a scan of a second visit on the drifted map of the first seed
    real: Path | None = None  #: folder of real scans
    out: Path | None = None  #: folder for pictures


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Run:
    """One scenario, built and held against the truth."""

    scenario: Scenario
    seed: int
    built: BuiltMap
    assessment: Assessment
    seconds: dict[str, float]  #: by stage, and in `total`
    processor_seconds: float  #: of all processes

    def document(self) -> dict[str, Any]:
        """JSON-ready."""
        report = self.built.report
        return {
            "scenario": self.scenario.kind,
            "seed": self.seed,
            **self.assessment.document(),
            "report": None if report is None else report.document(),
            "tiles": len(self.built.tiles.points),
            "map_points": len(self.built.reference.points),
            "seconds": self.seconds,
            "processor_seconds": self.processor_seconds,
            "reasons": {
                outcome.name: outcome.reason for outcome in self.built.outcomes if not outcome.placement
            },
        }


def evaluate(settings: BenchmarkSettings, progress: Progress = no_progress) -> dict[str, Any]:
    """Run all of it; JSON-ready. Raises MapFailed where a scenario makes no map, OSError for the folders."""
    if settings.plain and "drifted" not in settings.kinds:
        raise ValueError("the plain way is run on the scenario `drifted`; name it among the scenarios")
    result: dict[str, Any] = {"machine": _machine(), "paper": PAPER, "scenarios": []}
    for seed in settings.seeds:
        walk = replace(settings.walk, seed=seed)
        with TemporaryDirectory(prefix="spicd-registration-") as folder:
            taken = take_walk(walk, Path(folder), progress)
            for kind in settings.kinds:
                run = run_scenario(scenario(taken, kind, seed=seed), seed, progress)
                result["scenarios"].append(run.document())
                if settings.out is not None:
                    draw_run(settings.out, run.scenario, seed, run.built, run.assessment)
                if kind == "drifted" and seed == settings.seeds[0]:
                    result |= _beside(run, walk, Path(folder), settings, progress)
    if settings.real is not None:
        result["real"] = evaluate_real(settings.real, progress)
    return result


def run_scenario(given: Scenario, seed: int, progress: Progress) -> Run:
    """Build the map once, against the clock. Raises MapFailed."""
    used = processor_seconds()
    clock = StageClock(progress, prefix=f"{given.kind}, seed {seed}: ")
    built = build_map(given.files, settings=PipelineSettings(), progress=clock)
    seconds = clock.seconds()
    reference = None if built.report is None else built.report.reference
    return Run(
        scenario=given,
        seed=seed,
        built=built,
        assessment=assess(built.outcomes, given.true, reference=reference),
        seconds=seconds,
        processor_seconds=processor_seconds() - used,
    )


def _beside(
    run: Run, walk: WalkSettings, folder: Path, settings: BenchmarkSettings, progress: Progress
) -> dict[str, Any]:
    """The plain way on the same scans, and a survey on the map."""
    beside: dict[str, Any] = {}
    if settings.plain:
        beside["plain"] = [
            {"gates": list(gates), **_plainly(run, gates, settings, progress)}
            for gates in (plain.COARSE_TO_FINE, plain.PAPER_GATES)
        ]
    if settings.survey and run.assessment.true_from_map is not None:
        progress("survey", 0.0)
        beside["survey"] = time_survey(run.built.reference, run.assessment.true_from_map, walk, folder)
    return beside


def _plainly(
    run: Run, gates: tuple[float, ...], settings: BenchmarkSettings, progress: Progress
) -> dict[str, Any]:
    kept = frozenset((min(p.target, p.source), max(p.target, p.source)) for p in run.built.kept)
    chosen = plain.PlainSettings(
        gates=gates, sample=settings.plain_pairs, always=kept if settings.plain_pairs else frozenset()
    )
    used = processor_seconds()
    there = plain.build_plainly(run.scenario.files, chosen, progress)
    used = processor_seconds() - used
    poses = {
        at: outcome.placement.map_from_scan
        for at, outcome in enumerate(run.built.outcomes)
        if outcome.placement
    }
    true: list[Matrix4] = [pose for pose in run.scenario.true if pose is not None]  # of all: none is foreign
    compared = compare(there, poses, kept, true)
    return {
        **compared,
        "processor_seconds": used,  # of the pairs that were run, nothing extrapolated
        "times_faster": compared["seconds"]["total"] / run.seconds["total"],
    }


def _machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
    }
