"""`spicd-worker evaluate paper`: the fourteen experiments, every method, both ways of choosing a threshold."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from worker.benchmarks.baselines import Baseline, CloudToCloud, M3c2, M3c2Approximation, m3c2_is_installed
from worker.benchmarks.paper.embedding import Embedding, embed
from worker.benchmarks.paper.experiment import Experiment
from worker.benchmarks.paper.measured import open_measured, training_log
from worker.benchmarks.paper.published import experiments
from worker.benchmarks.paper.robustness import RobustnessPoint, chosen_trials, sweep_disturbances
from worker.benchmarks.paper.scoring import (
    CachedDetector,
    MethodScores,
    scored_by_baseline,
    scored_by_detector,
)
from worker.benchmarks.paper.site import Site, SiteSettings, build_site
from worker.benchmarks.paper.trial import Trial, trials
from worker.benchmarks.plots import Log
from worker.detectors.card import MODEL_STORE, Card
from worker.detectors.detector import Detector
from worker.metrics import PAPER_SWEEP, best_f1
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

QUICK = ("magnitude_15cm", "type_remove", "baseline_no_change")


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperSettings:
    """What is run."""

    site: SiteSettings = field(default_factory=SiteSettings)
    validation_seed: int = 101  #: of the corridor that thresholds are chosen on
    model: str = "spicd-net/1"
    model_store: Path = MODEL_STORE
    weights: Path | None = None  #: a checkpoint of training, measured in place of the model's weights
    everywhere: bool = False  #: changes are in all scans of a tile, not in the modified one alone
    robustness: bool = True
    only: tuple[str, ...] | None = None  #: experiments to run; None: all


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Method:
    """A method, its scores, and its threshold chosen both ways."""

    test: MethodScores
    validation: MethodScores
    threshold: float  #: the best on the validation site; the honest one
    test_threshold: float  #: the best on the experiments themselves, as the paper's


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PaperResult:
    """Everything that tables and pictures are made of."""

    settings: PaperSettings
    card: Card  #: of the detector, with the sha256 of what was measured
    site: Site
    validation: Site
    trials: tuple[Trial, ...]
    detector: Method
    baselines: tuple[Method, ...]
    left_out: tuple[str, ...]  #: methods that are not installed
    robustness: tuple[RobustnessPoint, ...]
    embedding: Embedding | None
    training: Log | None  #: of the detector, where it was kept
    seconds: float
    machine: dict[str, str | int | None]

    @property
    def methods(self) -> tuple[Method, ...]:
        """The detector before the baselines."""
        return (self.detector, *self.baselines)


def evaluate(settings: PaperSettings, progress: Progress = no_progress) -> PaperResult:
    """Run all of it. Raises DetectorUnavailable, MapFailed, and ValueError for unknown experiments."""
    begun = time.perf_counter()
    chosen = _experiments(settings.only)
    detector = open_measured(settings.model_store, settings.model, settings.weights)
    log = training_log(settings.model_store, settings.model, settings.weights)
    pipeline = PipelineSettings().for_model(detector.card.preprocessing)
    sites, given = [], []
    for seed in (settings.site.seed, settings.validation_seed):
        site = build_site(replace(settings.site, seed=seed), pipeline, progress)
        sites.append(site)
        given.append(tuple(trials(site, chosen, progress, everywhere=settings.everywhere)))
    caches = [CachedDetector(detector=detector, tiles=site.tiles) for site in sites]
    progress(f"scoring by {settings.model}", 0.0)
    scores = [
        scored_by_detector(_name(settings), cache, part) for cache, part in zip(caches, given, strict=True)
    ]
    measured = _method(scores[0], scores[1], sweep_all=False)
    rivals = _baselines(given, progress)
    disturbed: tuple[RobustnessPoint, ...] = ()
    if settings.robustness:
        disturbed = sweep_disturbances(
            sites[0], chosen_trials(given[0]), caches[0], measured.threshold, progress
        )
    progress("embedding", 0.0)
    return PaperResult(
        settings=settings,
        card=detector.card,
        site=sites[0],
        validation=sites[1],
        trials=given[0],
        detector=measured,
        baselines=rivals,
        left_out=() if m3c2_is_installed() else ("M3C2",),
        robustness=disturbed,
        embedding=embed(caches[0], given[0], measured.test, measured.threshold),
        training=log,
        seconds=time.perf_counter() - begun,
        machine=_machine(detector),
    )


def _baselines(given: Sequence[tuple[Trial, ...]], progress: Progress) -> tuple[Method, ...]:
    methods: list[Baseline] = [CloudToCloud(), CloudToCloud(statistic="far"), M3c2Approximation()]
    if m3c2_is_installed():
        methods.append(M3c2())
    found = []
    for number, method in enumerate(methods):
        progress(f"scoring by {method.name}", number / len(methods))
        test, validation = (scored_by_baseline(method, part) for part in given)
        found.append(_method(test, validation, sweep_all=True))
    return tuple(found)


def _method(test: MethodScores, validation: MethodScores, *, sweep_all: bool) -> Method:
    """Probabilities are swept as the paper does, distances over every cut: they are metres or small shares."""
    thresholds = None if sweep_all else PAPER_SWEEP
    return Method(
        test=test,
        validation=validation,
        threshold=best_f1(validation.pooled, validation.truth, thresholds).threshold,
        test_threshold=best_f1(test.pooled, test.truth, thresholds).threshold,
    )


def _experiments(only: tuple[str, ...] | None) -> tuple[Experiment, ...]:
    every = experiments()
    if only is None:
        return every
    unknown = sorted(set(only) - {one.name for one in every})
    if unknown:
        raise ValueError(
            f"no experiment {', '.join(unknown)}; there are {', '.join(one.name for one in every)}"
        )
    return tuple(one for one in every if one.name in only)


def _name(settings: PaperSettings) -> str:
    return settings.model if settings.weights is None else settings.weights.name


def _machine(detector: Detector) -> dict[str, str | int | None]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "model": f"{detector.card.name}/{detector.card.version}",
    }
