"""What noise, lost points and a wrong registration do to the detector (paper, Section 5.8 and Figure 11)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.methods import CachedDetector
from worker.benchmarks.paper.experiments import Trial
from worker.benchmarks.paper.site import Site
from worker.cloud.poses import transformed
from worker.cloud.tiling import TilePairs, pair_tiles
from worker.cloud.types import Floats, Points
from worker.metrics import Confusion, confusion, pooled
from worker.progress import Progress
from worker.simulation.scenes import rigid

#: What is swept, in the unit of its name; the first level of each is nothing at all.
LEVELS: dict[str, tuple[float, ...]] = {
    "jitter (mm)": (0, 5, 10, 20),
    "dropout (%)": (0, 10, 20, 30, 50),
    "translation (cm)": (0, 1, 2, 5, 10),
    "yaw (degrees)": (0, 0.25, 0.5, 1, 2),
}
SEED = 42
#: What is disturbed: one experiment of each kind of change. The paper speaks of "a representative subset".
EXPERIMENTS = ("type_add", "type_remove", "type_move")


@dataclass(frozen=True, kw_only=True, slots=True)
class RobustnessPoint:
    """One level of one disturbance."""

    disturbance: str
    level: float
    counts: Confusion  #: of all trials together; a tile that a shifted map no longer observes is not flagged


def sweep_disturbances(
    site: Site, trials: Sequence[Trial], cached: CachedDetector, threshold: float, progress: Progress
) -> tuple[RobustnessPoint, ...]:
    """Score every trial at every level of every disturbance, at the threshold of the undisturbed ones."""
    wanted = [(what, level) for what, levels in LEVELS.items() for level in levels]
    points = []
    for number, (what, level) in enumerate(wanted):
        progress(f"robustness: {what}", number / len(wanted))
        counts = pooled(
            confusion(cached.score(disturbed(site, trial, what, level)), trial.truth, threshold)
            for trial in trials
        )
        points.append(RobustnessPoint(disturbance=what, level=level, counts=counts))
    return tuple(points)


def chosen_trials(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """Return those of EXPERIMENTS; where none of them was run, all that were."""
    return tuple(trial for trial in trials if trial.experiment.name in EXPERIMENTS) or tuple(trials)


def disturbed(site: Site, trial: Trial, what: str, level: float) -> TilePairs:
    """Disturb the trial's pairs: each tile's points, or the whole current map.

    A map is moved along the floor in a random direction, the same for all levels, or turned about its middle.
    Raises ValueError for a disturbance that LEVELS does not name.
    """
    rng = np.random.default_rng(SEED)
    if level == 0:
        return trial.pairs
    if what == "jitter (mm)":
        return _by_tile(trial.pairs, lambda points: points + rng.normal(0.0, level / 1000, points.shape))
    if what == "dropout (%)":
        return _by_tile(trial.pairs, lambda points: points[rng.random(len(points)) >= level / 100])
    if what == "translation (cm)":
        heading = rng.uniform(0, 2 * np.pi)
        shift = level / 100 * np.array([np.cos(heading), np.sin(heading), 0.0])
        moved: Floats = trial.current + shift
    elif what == "yaw (degrees)":
        moved = _turned(trial.current, level)
    else:
        raise ValueError(f"no disturbance {what}; there are {', '.join(LEVELS)}")
    return pair_tiles(site.tiles, moved.astype(np.float32), settings=site.settings.tiling)


def _by_tile(pairs: TilePairs, change: Callable[[Points], NDArray[Any]]) -> TilePairs:
    return replace(pairs, current=tuple(change(points).astype(np.float32) for points in pairs.current))


def _turned(points: Points, yaw: float) -> Floats:
    middle = np.append((points.min(axis=0) + points.max(axis=0))[:2] / 2, 0.0)
    turned: Floats = transformed(points - middle, rigid(yaw=yaw)) + middle
    return turned
