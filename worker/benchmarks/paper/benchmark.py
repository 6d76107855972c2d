"""`spicd-worker evaluate paper`: the fourteen experiments, every method, both ways of choosing a threshold."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from worker.benchmarks.baselines import m3c2_is_installed
from worker.benchmarks.documents import Document
from worker.benchmarks.methods import CachedDetector, baseline_methods, open_model, training_log
from worker.benchmarks.paper.experiments import Trial, experiments, trials
from worker.benchmarks.paper.robustness import RobustnessPoint, chosen_trials, sweep_disturbances
from worker.benchmarks.paper.scores import (
    Embedding,
    MethodScores,
    embed,
    scored_by_baseline,
    scored_by_detector,
)
from worker.benchmarks.paper.site import Site, SiteSettings, build_site
from worker.benchmarks.plots import Log
from worker.benchmarks.timing import machine
from worker.detectors.card import MODEL_STORE, Card, Preprocessing
from worker.detectors.detector import Detector
from worker.metrics import PAPER_SWEEP, Confusion, best_f1, confusion
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

QUICK = ("magnitude_15cm", "type_remove", "baseline_no_change")


@dataclass(frozen=True, kw_only=True, slots=True)
class PaperSettings:
    """What is run."""

    site: SiteSettings = field(default_factory=SiteSettings)
    validation_seed: int = 101  #: of the corridor that thresholds are chosen on
    model: str = "spicd-net/2"
    model_store: Path = MODEL_STORE
    weights: Path | None = None  #: a checkpoint of training, measured in place of the model's weights
    everywhere: bool = False  #: changes are in all scans of a tile, not in the modified one alone
    robustness: bool = True
    only: tuple[str, ...] | None = None  #: experiments to run; None: all

    @property
    def measured(self) -> str:
        """The name of what is measured."""
        return self.model if self.weights is None else self.weights.name


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MethodResult:
    """A method's scores, and its threshold chosen both ways."""

    test: MethodScores
    validation: MethodScores
    threshold: float  #: the best on the validation site; the honest one
    test_threshold: float  #: the best on the experiments themselves, as the paper's

    def counts(self, threshold: float) -> tuple[Confusion, ...]:
        """Count the tiles of each experiment, in their order."""
        return tuple(
            confusion(scores, truth, threshold)
            for scores, truth in zip(self.test.scores, self.test.truths, strict=True)
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PaperResult:
    """Everything that tables and pictures are made of."""

    settings: PaperSettings
    card: Card  #: of the detector, with the sha256 of what was measured
    site: Site
    validation: Site
    trials: tuple[Trial, ...]
    detector: MethodResult
    baselines: tuple[MethodResult, ...]
    left_out: tuple[str, ...]  #: methods that are not installed
    robustness: tuple[RobustnessPoint, ...]
    embedding: Embedding | None
    training: Log | None  #: of the detector, where it was kept
    seconds: float
    machine: Document

    @property
    def methods(self) -> tuple[MethodResult, ...]:
        """The detector before the baselines."""
        return (self.detector, *self.baselines)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _CarriedOut:
    """Both corridors with every experiment on them, and what the baselines make of it."""

    sites: tuple[Site, Site]  #: of the test, of the validation
    trials: tuple[tuple[Trial, ...], tuple[Trial, ...]]  #: likewise
    baselines: tuple[MethodResult, ...]
    seconds: float  #: to make all of it


def evaluate(settings: PaperSettings, progress: Progress = no_progress) -> PaperResult:
    """Run all of it. Raises DetectorUnavailable, MapFailed, and ValueError for unknown experiments."""
    (result,) = evaluate_each(settings, (settings.model,), progress)
    return result


def evaluate_each(
    settings: PaperSettings, models: Sequence[str], progress: Progress = no_progress
) -> Iterator[PaperResult]:
    """Run all of it for several models; those that need the same voxels and tiles share corridors and experiments.

    Raises as `evaluate` does, before anything is made where a model cannot be opened.
    """
    opened = [(model, open_model(settings.model_store, model, settings.weights)) for model in models]
    made: dict[str, _CarriedOut] = {}
    for model, detector in opened:
        needs = detector.card.preprocessing.model_dump_json()
        if needs not in made:
            made[needs] = _carried_out(settings, detector.card.preprocessing, progress)
        yield _measured(replace(settings, model=model), detector, made[needs], progress)


def _carried_out(settings: PaperSettings, needs: Preprocessing, progress: Progress) -> _CarriedOut:
    begun = time.perf_counter()
    chosen = experiments(settings.only)
    # The stored reference is the dense tiles, as the paper has it, whatever the detector could score besides.
    pipeline = PipelineSettings().for_model(needs.model_copy(update={"tiles": "dense"}))

    def made(seed: int) -> tuple[Site, tuple[Trial, ...]]:
        site = build_site(replace(settings.site, seed=seed), pipeline, progress)
        by_voxels = needs.tiles == "touched"
        return site, tuple(trials(site, chosen, progress, everywhere=settings.everywhere, seen=by_voxels))

    (site, test), (other_site, validation) = made(settings.site.seed), made(settings.validation_seed)
    return _CarriedOut(
        sites=(site, other_site),
        trials=(test, validation),
        baselines=_baselines((test, validation), progress),
        seconds=time.perf_counter() - begun,
    )


def _measured(
    settings: PaperSettings, detector: Detector, made: _CarriedOut, progress: Progress
) -> PaperResult:
    begun = time.perf_counter()
    caches = [CachedDetector(detector=detector) for _ in made.sites]
    progress(f"scoring by {settings.model}", 0.0)
    test, validation = (
        scored_by_detector(settings.measured, cache, part)
        for cache, part in zip(caches, made.trials, strict=True)
    )
    ours = _result(test, validation, sweep_all=False)
    disturbed: tuple[RobustnessPoint, ...] = ()
    # What is disturbed are points of tiles, not what scans saw.
    if settings.robustness and detector.card.preprocessing.tiles != "touched":
        swept = chosen_trials(made.trials[0])
        disturbed = sweep_disturbances(made.sites[0], swept, caches[0], ours.threshold, progress)
    progress("embedding", 0.0)
    return PaperResult(
        settings=settings,
        card=detector.card,
        site=made.sites[0],
        validation=made.sites[1],
        trials=made.trials[0],
        detector=ours,
        baselines=made.baselines,
        left_out=() if m3c2_is_installed() else ("M3C2",),
        robustness=disturbed,
        embedding=embed(caches[0], made.trials[0], ours.test, ours.threshold),
        training=training_log(settings.model_store, settings.model, settings.weights),
        seconds=made.seconds + time.perf_counter() - begun,
        machine=machine(model=f"{detector.card.name}/{detector.card.version}"),
    )


def _baselines(carried_out: Sequence[tuple[Trial, ...]], progress: Progress) -> tuple[MethodResult, ...]:
    methods, results = baseline_methods(), []
    for number, method in enumerate(methods):
        progress(f"scoring by {method.name}", number / len(methods))
        test, validation = (scored_by_baseline(method, part) for part in carried_out)
        results.append(_result(test, validation, sweep_all=True))
    return tuple(results)


def _result(test: MethodScores, validation: MethodScores, *, sweep_all: bool) -> MethodResult:
    """Choose thresholds: probabilities are swept as in the paper, distances (metres, small shares) over every cut."""
    thresholds = None if sweep_all else PAPER_SWEEP
    return MethodResult(
        test=test,
        validation=validation,
        threshold=best_f1(validation.pooled, validation.truth, thresholds).threshold,
        test_threshold=best_f1(test.pooled, test.truth, thresholds).threshold,
    )
