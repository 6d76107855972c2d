"""`spicd-worker evaluate registration`: every scenario of every seed, and what stands beside it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worker.benchmarks.documents import Document
from worker.benchmarks.registration import baseline
from worker.benchmarks.registration.assessment import Assessment, assess
from worker.benchmarks.registration.real import evaluate_real
from worker.benchmarks.registration.report import draw_run
from worker.benchmarks.registration.scenarios import (
    KINDS,
    Scenario,
    ScenarioKind,
    ScenarioSettings,
    scenario,
    take_walk,
)
from worker.benchmarks.timing import StageClock, machine, processor_seconds
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.flow import BuiltMap, build_map
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.scan_to_map import register
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress
from worker.simulation.visits import DRIFT, drifted_within, stops, visit

REPEATS = 7  #: of registering a survey's scan, after one that warms up

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
class RegistrationBenchmarkSettings:
    """What is run."""

    walk: ScenarioSettings = field(default_factory=ScenarioSettings)  #: its seed gives way to each of `seeds`
    seeds: tuple[int, ...] = (1,)
    kinds: tuple[ScenarioKind, ...] = KINDS
    baseline: bool = False  #: the Open3D baseline too, on the drifted scans of the first seed
    baseline_pairs: int | None = None  #: so many random pairs instead of all, and the seconds extrapolated
    survey: bool = True  #: time a scan of a second visit on the drifted map of the first seed
    real: Path | None = None  #: folder of real scans
    out: Path | None = None  #: folder for pictures


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ScenarioRun:
    """One scenario, built and held against the truth."""

    scenario: Scenario
    seed: int
    built: BuiltMap
    assessment: Assessment
    seconds: dict[str, float]  #: by stage, and in `total`
    processor_seconds: float  #: of all processes

    def document(self) -> Document:
        """Return it as JSON."""
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
                outcome.name: outcome.reason for outcome in self.built.outcomes if not outcome.registration
            },
        }


def evaluate(settings: RegistrationBenchmarkSettings, progress: Progress = no_progress) -> Document:
    """Run all of it, and draw what is to be drawn; JSON-ready.

    Raises MapFailed where a scenario makes no map, OSError for the folders.
    """
    if settings.baseline and "drifted" not in settings.kinds:
        raise ValueError("the baseline is run on the scenario `drifted`; name it among the scenarios")
    result: Document = {"machine": machine(load=os.getloadavg()[0]), "paper": PAPER, "scenarios": []}
    for seed in settings.seeds:
        walk = replace(settings.walk, seed=seed)
        with TemporaryDirectory(prefix="spicd-registration-") as folder:
            scans = take_walk(walk, Path(folder), progress)
            for kind in settings.kinds:
                run = run_scenario(scenario(scans, kind, seed=seed), seed, progress)
                result["scenarios"].append(run.document())
                if settings.out is not None:
                    draw_run(settings.out, run.scenario, seed, run.built, run.assessment)
                if kind == "drifted" and seed == settings.seeds[0]:
                    result |= _beside(run, walk, Path(folder), settings, progress)
    if settings.real is not None:
        result["real"] = evaluate_real(settings.real, progress)
    return result


def run_scenario(given: Scenario, seed: int, progress: Progress) -> ScenarioRun:
    """Build the map once, against the clock. Raises MapFailed."""
    used = processor_seconds()
    clock = StageClock(progress, prefix=f"{given.kind}, seed {seed}: ")
    built = build_map(given.files, settings=PipelineSettings(), progress=clock)
    seconds = clock.seconds()
    reference = None if built.report is None else built.report.reference
    return ScenarioRun(
        scenario=given,
        seed=seed,
        built=built,
        assessment=assess(built.outcomes, given.true, reference=reference),
        seconds=seconds,
        processor_seconds=processor_seconds() - used,
    )


def _beside(
    run: ScenarioRun,
    walk: ScenarioSettings,
    folder: Path,
    settings: RegistrationBenchmarkSettings,
    progress: Progress,
) -> Document:
    """Run the baseline on the same scans, and a survey on the map."""
    beside: Document = {}
    if settings.baseline:
        beside["plain"] = [
            {"gates": list(distances), **_baseline(run, distances, settings, progress)}
            for distances in (baseline.COARSE_TO_FINE, baseline.PAPER_DISTANCES)
        ]
    if settings.survey and run.assessment.true_from_map is not None:
        progress("survey", 0.0)
        beside["survey"] = time_survey(run.built.reference, run.assessment.true_from_map, walk, folder)
    return beside


def _baseline(
    run: ScenarioRun,
    distances: tuple[float, ...],
    settings: RegistrationBenchmarkSettings,
    progress: Progress,
) -> Document:
    kept = frozenset((min(p.target, p.source), max(p.target, p.source)) for p in run.built.kept)
    chosen = baseline.BaselineSettings(
        distances=distances,
        sample=settings.baseline_pairs,
        always=kept if settings.baseline_pairs else frozenset(),
    )
    used = processor_seconds()
    theirs = baseline.build_baseline(run.scenario.files, chosen, progress)
    used = processor_seconds() - used
    ours = {
        scan: outcome.registration.map_from_scan
        for scan, outcome in enumerate(run.built.outcomes)
        if outcome.registration
    }
    true = [pose for pose in run.scenario.true if pose is not None]  # all: none is out of place
    compared = baseline.compare(theirs, ours, kept, true)
    return {
        **compared,
        "processor_seconds": used,  # of the pairs that were run, nothing extrapolated
        "times_faster": compared["seconds"]["total"] / run.seconds["total"],
    }


def time_survey(
    reference: ReferenceMap, true_from_map: Matrix4, walk: ScenarioSettings, folder: Path
) -> Document:
    """Register a scan from the middle of a second visit to a loaded map, its prior drifted, over and over; JSON-ready.

    The map's surface and tree are made once, before the clock runs; reading the file is counted apart,
    voxels and normals of the scan are part of registering it.
    """
    scene, settings, seed = walk.scene(), PipelineSettings().registration, walk.seed + 1
    poses = stops(scene, walk.scans, seed=seed)
    (simulated,) = visit(
        scene,
        (poses[len(poses) // 2],),
        seed=seed,
        prior_error=DRIFT,
        drift=drifted_within,
        duration_s=walk.duration_s,
        folder=folder,
        name="survey",
    )
    map_from_true = inverse(true_from_map)
    surface, prior = reference.surface(), map_from_true @ simulated.prior
    seconds = []
    for _ in range(REPEATS + 1):
        begun, used = time.perf_counter(), time.process_time()
        scan = read_scan(folder / "survey.pcd")
        read = time.perf_counter()
        hypothesis = register(prepare(scan, settings), surface, prior=prior, settings=settings)
        seconds.append((read - begun, time.perf_counter() - read, time.process_time() - used))
    reading, registering, processor = np.array(seconds[1:]).T
    metres, radians = difference(map_from_true @ simulated.world_from_sensor, hypothesis.target_from_source)
    return {
        "points": len(scan.points),
        "map_points": len(reference.points),
        "read_seconds": float(np.median(reading)),
        "register_seconds": float(np.median(registering)),
        "register_least": float(registering.min()),
        "register_most": float(registering.max()),
        "processor_seconds": float(np.median(processor)),
        "centimetres": 100 * metres,
        "degrees": float(np.degrees(radians)),
    }
