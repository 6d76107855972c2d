"""What the network costs: the paper's plain way, and ours step by step, on the same tiles and with the same scores."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.detectors.spicd_net.detector import SpicdNet
from worker.evaluation.plain_inference import plain_scores
from worker.pipeline.tiling import TilePairs
from worker.progress import Progress, silent

PLAIN = "plain"  #: what the others are held against

Way = Callable[[], NDArray[np.float32]]  #: to (T, 3) probabilities


def network_bench(
    pairs: TilePairs, detector: SpicdNet, *, repeats: int, progress: Progress = silent
) -> dict[str, Any]:
    """Run each way `repeats` times, in turn; JSON-ready, seconds for all pairs.

    On a shared machine seconds are worth little by themselves, so all ways run in one go and are given as ratios too.
    """
    every = ways(pairs, detector)
    seconds: dict[str, list[float]] = {name: [] for name in every}
    scores: dict[str, NDArray[np.float32]] = {}
    for turn in range(repeats):
        for number, (name, run) in enumerate(every.items()):
            progress(f"network, {name}", (turn + number / len(every)) / repeats)
            begun = time.perf_counter()
            scores[name] = run()
            seconds[name].append(time.perf_counter() - begun)
    plain = float(np.median(seconds[PLAIN]))
    return {
        "tiles": len(pairs.observed),
        "distinct_points_per_tile": round(float(np.mean([len(points) for points in pairs.current]))),
        "seconds": {name: _spread(values) for name, values in seconds.items()},
        "times_faster_than_plain": {
            name: round(plain / float(np.median(values)), 1) for name, values in seconds.items()
        },
        "largest_score_difference": max(
            float(np.nanmax(np.abs(found - scores[PLAIN]))) for found in scores.values()
        ),
    }


def ways(pairs: TilePairs, detector: SpicdNet) -> dict[str, Way]:
    """The slowest first; each spares something that the one before does not."""
    description = detector.describe(pairs.reference)
    return {
        PLAIN: lambda: plain_scores(detector, pairs),
        "uncached_padded": lambda: detector.score(pairs, padded=True).probabilities,
        "uncached_distinct": lambda: detector.score(pairs).probabilities,
        "cached_distinct": lambda: detector.score(pairs, description=description).probabilities,
    }


def resized(pairs: TilePairs, count: int) -> TilePairs:
    """`count` observed pairs, the first ones or some twice."""
    chosen = np.resize(np.flatnonzero(pairs.observed), count)
    reference = pairs.reference
    return TilePairs(
        reference=replace(
            reference,
            indices=reference.indices[chosen],
            points=tuple(reference.points[tile] for tile in chosen),
        ),
        current=tuple(pairs.current[tile] for tile in chosen),
        observed=np.ones(count, bool),
    )


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": float(np.median(values)), "least": min(values), "most": max(values)}
