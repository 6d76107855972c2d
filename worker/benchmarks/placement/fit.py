"""Fitting the line of `worker.pipeline.placement.belief`: poses of the calibration trials, right and wrong ones.

Every pose that the search refines is a sample: of right scans at their place and elsewhere, and of other places. Those
of hotels are left out, where nothing may tell a wrong pose from a right one, and so are poses that surfaces refuse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.table import Table
from scipy.optimize import minimize

from worker.benchmarks.documents import Document
from worker.benchmarks.placement.plan import Kind, PlacementSettings, Trial, trials
from worker.benchmarks.placement.sites import load_site
from worker.benchmarks.placement.surveys import simulate
from worker.cloud.poses import difference
from worker.cloud.types import Bools, Floats, Matrix4
from worker.pipeline.placement.belief import FEWEST, Line, shares
from worker.pipeline.placement.contradictions import Place
from worker.pipeline.placement.placed_scan import PlacedScan
from worker.pipeline.placement.scan_placement import poses_tried
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.results import ScanRejected, with_carrier
from worker.processes import open_processes
from worker.progress import Progress, no_progress

KINDS: tuple[Kind, ...] = ("right", "other", "same-size", "twin", "prior-off", "low-overlap", "wedge")
RIGHT, NEAR = (
    (0.1, 0.02),
    0.35,
)  #: metres and radians; metres: what is off by less than this is neither right nor wrong
SMOOTH = 3e-4  #: weight of the squared, standardised weights
_OVERLAP, _INLIER_RATIO, _RMSE = 0.3, 0.8, 0.05  # what surfaces ask at least


@dataclass(frozen=True, kw_only=True, slots=True)
class Sample:
    """One pose."""

    trial: str
    shares: tuple[float, ...]  #: as `belief.shares` has them
    right: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class _Task:
    trial: Trial
    settings: PlacementSettings
    folder: Path


def fit_line(
    settings: PlacementSettings,
    folder: Path,
    *,
    processes: int,
    most: int | None = None,
    progress: Progress = no_progress,
) -> Document:
    """Fit the line on at most so many trials of each row; JSON-ready. Raises MapFailed, OSError."""
    planned = [trial for trial in trials(settings, "calibration", only=KINDS, most=most) if not _alike(trial)]
    tasks = [_Task(trial=trial, settings=settings, folder=folder) for trial in planned]
    samples: list[Sample] = []
    with open_processes(processes) as pool:
        for done, found in enumerate(pool.map_unordered(_samples_of, tasks)):
            samples += found
            progress("registering", done / len(tasks))
    samples.sort(key=lambda sample: (sample.trial, sample.shares))
    right = np.array([sample.right for sample in samples])
    rows = np.array([sample.shares for sample in samples])
    line = fitted(rows, right)
    odds = np.array([line.log_odds(row) for row in rows])
    return {
        "trials": len(tasks),
        "right": int(right.sum()),
        "wrong": int((~right).sum()),
        "bias": line.bias,
        "weights": list(line.weights),
        "right_log_odds": np.percentile(odds[right], (0, 1, 5, 50)).tolist(),
        "wrong_log_odds": np.percentile(odds[~right], (50, 95, 99, 100)).tolist(),
    }


def fit_table(result: Document) -> Table:
    """Show the line as `belief.LINE` has it, and how far right and wrong poses are apart on it."""
    table = Table(show_header=False)
    table.add_row("bias", f"{result['bias']:.2f}")
    table.add_row("weights", ", ".join(f"{weight:.2f}" for weight in result["weights"]))
    table.add_row("poses", f"{result['right']} right, {result['wrong']} wrong, of {result['trials']} trials")
    for which, shares_told in (("right", "least, 1%, 5%, half"), ("wrong", "half, 95%, 99%, most")):
        odds = ", ".join(f"{value:.1f}" for value in result[f"{which}_log_odds"])
        table.add_row(f"log odds of {which} ones", f"{odds} ({shares_told})")
    return table


def fitted(rows: Floats, right: Bools, *, smooth: float = SMOOTH) -> Line:
    """Fit a logistic line on shares (N, 7), right and wrong poses weighing alike; no share may speak for a pose."""
    roots = np.sqrt(rows)
    mean, spread = roots.mean(axis=0), roots.std(axis=0) + 1e-9
    standard = (roots - mean) / spread
    weight = np.where(right, 0.5 / max(right.sum(), 1), 0.5 / max((~right).sum(), 1))

    def loss(line: Floats) -> float:
        odds = standard @ line[:-1] + line[-1]
        wrongness = np.logaddexp(0, np.where(right, -odds, odds))
        return float(weight @ wrongness + smooth * (line[:-1] ** 2).sum())

    count = rows.shape[1]
    bounds = [(None, 0.0)] * count + [(None, None)]
    found = minimize(loss, np.zeros(count + 1), bounds=bounds).x
    weights = found[:-1] / spread
    return Line(bias=float(found[-1] - weights @ mean), weights=tuple(weights.tolist()))


def _alike(trial: Trial) -> bool:
    return trial.site.kind.startswith("hotel")


def _samples_of(task: _Task) -> list[Sample]:
    site = load_site(task.trial.site, task.settings, task.folder)
    place = Place(surface=site.reference.surface(), sights=site.seen.sights)
    pipeline, samples = task.settings.pipeline, []
    with TemporaryDirectory(prefix="spicd-placement-") as scratch:
        survey = simulate(task.trial, site, task.settings, Path(scratch))
        files = with_carrier(survey.files, pipeline.carrier, max_points=pipeline.max_scan_points)
        for file, true in zip(files, survey.true, strict=True):
            try:
                scan = prepare(
                    file.read(max_points=pipeline.max_scan_points), pipeline.registration, with_sights=True
                )
            except ScanRejected:
                continue
            tried = poses_tried(
                scan,
                place,
                prior=file.prior(scan.sensor_pose),
                registration=pipeline.registration,
                placement=pipeline.placement,
            )
            samples += _samples(task.trial.name, tried, true)
    return samples


def _samples(name: str, tried: Sequence[PlacedScan], true: Matrix4 | None) -> list[Sample]:
    samples = []
    for placed in tried:
        if placed.told is None or placed.told.judged.sum(axis=1).min() < FEWEST or not _on_surfaces(placed):
            continue
        metres, radians = (np.inf, np.inf) if true is None else difference(placed.pose, true)
        right = metres < RIGHT[0] and radians < RIGHT[1]
        if right or metres >= NEAR:
            told = tuple(shares(placed.told).tolist())
            samples.append(Sample(trial=name, shares=told, right=right))
    return samples


def _on_surfaces(placed: PlacedScan) -> bool:
    found = placed.hypothesis
    close = found.two_way_inlier_ratio >= _INLIER_RATIO and found.inlier_rmse < _RMSE
    return close and found.overlap >= _OVERLAP
