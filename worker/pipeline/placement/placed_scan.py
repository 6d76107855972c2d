"""Placed scans: a pose of a scan with what speaks for it and against it, and the error of a scan that has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worker.cloud.types import Matrix4
from worker.pipeline.placement.belief import confidence
from worker.pipeline.placement.contradictions import BUILDING, THINGS, Contradictions, Held
from worker.pipeline.registration.diagnosis import Diagnosis
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.verification import rejected


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacedScan:
    """A pose of a scan with what speaks for it and against it."""

    hypothesis: Hypothesis
    told: Contradictions | None  #: None where no rays are known, of the scan or of the map
    log_odds: float | None  #: None where both visits saw too little of each other
    held: tuple[Held, Held] | None = None  #: the points behind it, both ways
    warnings: tuple[Diagnosis, ...] = ()

    @property
    def pose(self) -> Matrix4:
        """(4, 4) map_from_scan."""
        return self.hypothesis.target_from_source

    @property
    def confidence(self) -> float | None:
        """0..1, None as `log_odds` is."""
        return None if self.log_odds is None else confidence(self.log_odds)

    @property
    def rank(self) -> tuple[float, float]:
        """What poses of one scan are sorted by: the odds, then the score."""
        return (-np.inf if self.log_odds is None else self.log_odds, self.hypothesis.score)


class NotPlaced(ScanRejected):
    """A scan that was looked for everywhere and has no place; the poses that came nearest stand beside the reason."""

    def __init__(self, refused: ScanRejected | Diagnosis, hypotheses: Sequence[Hypothesis] = ()) -> None:
        if isinstance(refused, ScanRejected):
            fitness, inlier_rmse = refused.fitness, refused.inlier_rmse
            super().__init__(refused.diagnosis, fitness=fitness, inlier_rmse=inlier_rmse)
        else:  # as an exception is read that came from another process
            super().__init__(refused)
        self.hypotheses = tuple(hypotheses)  #: best first


def other_place(name: str, placed: PlacedScan) -> ScanRejected:
    """Return the error of a scan that rays contradict at its best pose."""
    numbers = numbers_of(placed)
    return rejected(
        name,
        placed.hypothesis,
        "other_place",
        f"it fits the map's surfaces, but rays went through {numbers['building_seen_through']:.1%} of the walls, "
        f"floor and ceiling and {numbers['things_seen_through']:.0%} of the things that both visits looked at "
        f"(confidence {placed.confidence or 0.0:.2f}); it is of another place, or too much has changed",
        **numbers,
    )


def numbers_of(placed: PlacedScan) -> dict[str, float]:
    """Return what diagnoses tell of a pose: shares contradicted and the confidence, 0..1, and how many things."""
    told = placed.told
    if told is None:
        return {}
    judged, through = told.judged.sum(axis=0), told.through.sum(axis=0)
    numbers = {
        "building_seen_through": float(through[BUILDING] / max(judged[BUILDING], 1)),
        "things_seen_through": float(through[THINGS] / max(judged[THINGS], 1)),
        "things_that_agree": float(told.things[:, 0].sum()),
        "things_denied": float(told.things[:, 1].sum()),
    }
    return numbers if placed.confidence is None else {**numbers, "confidence": placed.confidence}
