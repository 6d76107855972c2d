"""`spicd-worker evaluate speed`: what all models of a store and the baselines take for 172 tiles, in one run.

On a shared machine seconds are worth little by themselves, so all take turns, and are given as multiples of C2C and in
processor seconds too. Each is given what it has in use: the reference embedding that a map keeps, or what scans saw,
and the precision that its card allows; where that is bfloat16, it is timed in float32 as well.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import torch
from rich.console import Group

from worker.benchmarks.baselines import installed_baselines
from worker.benchmarks.documents import Document, spread, titled_table
from worker.benchmarks.methods import change_scores, encode_reference, stored_models
from worker.benchmarks.speed import (
    PAPER_TILES,
    BenchSettings,
    full_comparison,
    full_visit,
    resized,
    side_by_side,
    simulated_visit,
    told_by_voxels,
)
from worker.benchmarks.timing import machine, processor_name, processor_seconds
from worker.benchmarks.trajectory import map_frame, scan_files
from worker.cloud.tiling import TilePairs
from worker.detectors.card import MODEL_STORE
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detector
from worker.detectors.precision import Precision, chosen_precision
from worker.detectors.running.runtime import RunsNetwork, Runtime
from worker.detectors.store import open_detector, resolve_device
from worker.errors import DetectorUnavailable
from worker.pipeline.flow import build_map
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

YARDSTICK = "C2C (mean)"  #: what the others are held against


@dataclass(frozen=True, kw_only=True, slots=True)
class SpeedSettings:
    """What is simulated, and what is timed."""

    scans: int = 25
    seed: int = 1
    tiles: int = PAPER_TILES
    repeats: int = 3
    model_store: Path = MODEL_STORE


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Timed:
    """A way of scoring."""

    run: Callable[[], object]
    tiles: int  #: that one run scores
    detector: Detector | None = None  #: None: a baseline
    precision: Precision | None = None  #: None: nothing that could be chosen


def measure(settings: SpeedSettings, progress: Progress = no_progress) -> Document:
    """Run all of it; JSON-ready. Raises MapFailed; a model that does not open is named in `left_out`."""
    pairs, comparison = _scene(settings, progress)
    detectors, left_out = _opened(settings.model_store)
    runs = {
        baseline.name: Timed(run=partial(baseline.score, pairs), tiles=len(pairs.observed))
        for baseline in installed_baselines()
    }
    for detector in detectors:
        name = detector.card.model
        runs[name] = _timed(detector, pairs, comparison)
        if runs[name].precision == "bfloat16":
            exact = open_detector(settings.model_store, name)
            runs[f"{name} in float32"] = replace(_timed(exact, pairs, comparison), precision="float32")
    seconds = times_of({name: timed.run for name, timed in runs.items()}, settings.repeats, progress)
    points = round(float(np.mean([len(tile) for tile in pairs.current])))
    return {
        "data": {
            "corridor": settings.seed,
            "scans": settings.scans,
            "tiles": settings.tiles,
            "points_per_tile": points,
        },
        "machine": machine(
            processor=processor_name(),
            cores_used=torch.get_num_threads(),
            torch=torch.__version__,
            device=torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
            load_before=round(os.getloadavg()[0], 1),
        ),
        "left_out": left_out,
        "methods": [_row(name, timed, seconds[name], seconds[YARDSTICK]) for name, timed in runs.items()],
    }


def _scene(settings: SpeedSettings, progress: Progress) -> tuple[TilePairs, Comparison]:
    """Return as many dense tiles as are asked for, and both whole clouds with what their scans saw."""
    made = BenchSettings(scans=settings.scans, seed=settings.seed)
    pipeline = PipelineSettings()
    with TemporaryDirectory(prefix="spicd-speed-") as name:
        progress("simulating", 0.0)
        first, second = (simulated_visit(made, number, Path(name)) for number in range(2))
        built = build_map(scan_files(first), settings=pipeline, progress=progress)
    frame = map_frame(built.outcomes, first)
    comparison = full_comparison(second, built, frame, built.seen, pipeline)
    return resized(full_visit(second, built, frame), settings.tiles), comparison


def _opened(model_store: Path) -> tuple[list[Detector], list[str]]:
    detectors, left_out = [], []
    for model in stored_models(model_store):
        try:
            detectors.append(open_detector(model_store, model, runtime=Runtime(precision="auto")))
        except DetectorUnavailable as closed:
            left_out.append(str(closed))
    return detectors, left_out


def _timed(detector: Detector, pairs: TilePairs, comparison: Comparison) -> Timed:
    """Return a detector's run: of the tile pairs, or by voxels of the whole clouds, of as many dense tiles as there are."""
    if detector.card.preprocessing.tiles == "touched":
        dense = int(comparison.tile_pairs.observed.sum())
        run: Callable[[], object] = lambda: told_by_voxels(side_by_side(comparison), detector)  # noqa: E731
        return Timed(run=run, tiles=dense, detector=detector, precision=_precision(detector))
    embedding = encode_reference(detector, pairs.reference)
    return Timed(
        run=lambda: change_scores(detector, pairs, embedding),
        tiles=len(pairs.observed),
        detector=detector,
        precision=_precision(detector),
    )


def times_of(
    runs: Mapping[str, Callable[[], object]], repeats: int, progress: Progress = no_progress
) -> dict[str, list[tuple[float, float]]]:
    """Run all `repeats` times, in turn; the seconds of each run by the clock and of the processor."""
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for turn in range(repeats):
        for number, (name, run) in enumerate(runs.items()):
            progress(f"scoring by {name}", (turn + number / len(runs)) / repeats)
            begun, busy = time.perf_counter(), processor_seconds()
            run()
            seconds[name].append((time.perf_counter() - begun, processor_seconds() - busy))
    return seconds


def _row(
    name: str, timed: Timed, seconds: list[tuple[float, float]], yardstick: list[tuple[float, float]]
) -> Document:
    card = None if timed.detector is None else timed.detector.card
    clock, processor = zip(*seconds, strict=True)
    by_clock, by_processor = (float(np.median(column)) for column in zip(*yardstick, strict=True))
    return {
        "model": name,
        "sha256": None if card is None else card.sha256,
        "fingerprint": None if card is None else card.fingerprint,
        "precision": timed.precision,
        "tiles": timed.tiles,
        "seconds": spread(clock, "median", "least", "most", digits=3),
        "processor_seconds": spread(processor, "median", "least", "most", digits=3),
        "times_c2c": round(float(np.median(clock)) / by_clock, 2),
        "times_c2c_of_processor": round(float(np.median(processor)) / by_processor, 2),
    }


def _precision(detector: Detector) -> Precision | None:
    """Return what a network is computed with, as the workers choose it by the card; None without a network."""
    if not isinstance(detector, RunsNetwork):
        return None
    device = resolve_device("auto")
    kind: Literal["cpu", "cuda"] = "cuda" if device.type == "cuda" else "cpu"
    return chosen_precision("auto", device, holds=detector.card.holds_in_bfloat16(kind))


def tables(figures: Document) -> Group:
    """Show the seconds of each way of scoring on a terminal."""
    scene, by = figures["data"], figures["machine"]
    title = (
        f"{scene['tiles']} tiles, {scene['points_per_tile']} points each; {by['processor']}, {by['device']}, "
        f"{by['cores_used']} threads, load {by['load_before']} before"
    )
    rows = (
        (
            f"{row['model']} (bfloat16)" if row["precision"] == "bfloat16" else row["model"],
            f"{row['tiles']}",
            f"{row['seconds']['median']:.2f}",
            f"{row['seconds']['least']:.2f} to {row['seconds']['most']:.2f}",
            f"{row['processor_seconds']['median']:.2f}",
            f"{row['times_c2c']:.1f}",
            f"{row['times_c2c_of_processor']:.1f}",
        )
        for row in figures["methods"]
    )
    head = (
        "scoring",
        "tiles",
        "seconds (median)",
        "least to most",
        "processor seconds",
        "times C2C",
        "by processor",
    )
    return Group(titled_table(title, head, rows), *figures["left_out"])
