"""What the building of a map came to: the totals of the paper's Table 2, and what ours adds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np

from worker.pipeline.registration.results import ScanResult
from worker.pipeline.registration.scan_to_scan import PairResult


@dataclass(frozen=True, kw_only=True, slots=True)
class MapReport:
    """Totals; means and deviations are over the registrations that the map rests on, None where there is none."""

    scans: int
    accepted: int
    discarded: int
    pairs_possible: int  #: scans * (scans - 1) / 2
    pairs_tried: int  #: by ICP
    calls_saved: float  #: share of the possible pairs that needed no ICP, 0..1
    pairs_accepted: int  #: by their own numbers
    pairs_contradicted: int  #: of those, thrown out because loops do not close over them
    mean_rmse: float | None  #: metres
    std_rmse: float | None  #: metres
    mean_fitness: float | None  #: 0..1
    std_fitness: float | None
    reference: int | None  #: index of the reference scan; None where the map was there before

    @classmethod
    def of(
        cls,
        *,
        scans: int,
        accepted: int,
        pairs: Sequence[PairResult],
        kept: Sequence[PairResult],
        reference: int | None,
    ) -> Self:
        """`pairs` are all that were tried, `kept` those that the map rests on."""
        possible = scans * (scans - 1) // 2
        agreed = sum(pair.accepted for pair in pairs)
        rmse = np.array([pair.inlier_rmse for pair in kept])
        fitness = np.array([pair.fitness for pair in kept])
        return cls(
            scans=scans,
            accepted=accepted,
            discarded=scans - accepted,
            pairs_possible=possible,
            pairs_tried=len(pairs),
            calls_saved=1 - len(pairs) / possible if possible else 0.0,
            pairs_accepted=agreed,
            pairs_contradicted=agreed - len(kept),
            mean_rmse=float(rmse.mean()) if kept else None,
            std_rmse=float(rmse.std()) if kept else None,
            mean_fitness=float(fitness.mean()) if kept else None,
            std_fitness=float(fitness.std()) if kept else None,
            reference=reference,
        )

    @classmethod
    def of_outcomes(cls, outcomes: Sequence[ScanResult]) -> Self:
        """Of scans that were placed on a map that was there: each has one registration, to the map."""
        accepted = [outcome for outcome in outcomes if outcome.placement is not None]
        rmse = np.array([outcome.inlier_rmse for outcome in accepted], np.float64)
        fitness = np.array([outcome.fitness for outcome in accepted], np.float64)
        return cls(
            scans=len(outcomes),
            accepted=len(accepted),
            discarded=len(outcomes) - len(accepted),
            pairs_possible=len(outcomes),
            pairs_tried=len(outcomes),
            calls_saved=0.0,
            pairs_accepted=len(accepted),
            pairs_contradicted=0,
            mean_rmse=float(rmse.mean()) if accepted else None,
            std_rmse=float(rmse.std()) if accepted else None,
            mean_fitness=float(fitness.mean()) if accepted else None,
            std_fitness=float(fitness.std()) if accepted else None,
            reference=None,
        )

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)
