"""Calibration: whether of all that a method gives a probability of 0.7, seven of ten truly changed.

The reliability diagram and the expected calibration error (ECE) of Guo et al., "On Calibration of Modern Neural
Networks" (ICML 2017). Nearly all voxels and tiles are unchanged and told so, which makes any error small; so the ECE is
also taken over those alone that a method gives at least `SAID`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.cloud.seen import Seen
from worker.cloud.types import Bools, Floats
from worker.cloud.voxel_keys import near, rows_of
from worker.detectors.detector import VoxelScores
from worker.simulation.hits import HitTruth, Visit

BINS = 10  #: of equal width, from 0 to 1
SAID = 0.1  #: probability from which a method has said something; an edge of a bin
MATCH, NEARBY = 1, 2  #: voxels; within the first a voxel is truly changed, within the second it may be


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Reliability:
    """Probabilities in bins, beside how many came true."""

    counts: NDArray[np.int64]  #: (BINS,)
    sums: Floats  #: (BINS,) of the probabilities
    changed: NDArray[np.int64]  #: (BINS,) that truly changed

    @classmethod
    def of(cls, probabilities: NDArray[np.floating[Any]], changed: Bools) -> Reliability:
        """Count N probabilities and whether each came true."""
        bins = np.minimum((probabilities * BINS).astype(np.int64), BINS - 1)
        return cls(
            counts=np.bincount(bins, minlength=BINS),
            sums=np.bincount(bins, weights=probabilities, minlength=BINS).astype(np.float64),
            changed=np.bincount(bins[changed], minlength=BINS),
        )

    @classmethod
    def pooled(cls, parts: Iterable[Reliability | None]) -> Reliability | None:
        """Add up those that there are."""
        there = [part for part in parts if part is not None]
        if not there:
            return None
        return cls(
            counts=np.sum([part.counts for part in there], axis=0),
            sums=np.sum([part.sums for part in there], axis=0),
            changed=np.sum([part.changed for part in there], axis=0),
        )

    def expected_error(self, least: float = 0.0) -> float | None:
        """Return the mean gap between probability and share that came true, from the bin of `least` up."""
        first = round(least * BINS)
        count = self.counts[first:].sum()
        return float(np.abs(self.sums - self.changed)[first:].sum() / count) if count else None

    def document(self) -> Document:
        """Return it as JSON."""

        def rounded(value: float | None) -> float | None:
            return None if value is None else round(value, 5)

        some = np.maximum(self.counts, 1)
        return {
            "counts": self.counts.tolist(),
            "mean_probability": np.round(self.sums / some, 4).tolist(),
            "share_changed": np.round(self.changed / some, 4).tolist(),
            "expected_calibration_error": rounded(self.expected_error()),
            f"expected_calibration_error_from_{SAID:g}": rounded(self.expected_error(SAID)),
        }


def voxel_reliability(voxels: VoxelScores, truth: HitTruth, first: Seen, second: Seen) -> Reliability | None:
    """Hold the probabilities of the voxels that could be judged against the truth by hits, both visits' together.

    A voxel is truly changed next to a decidable one of the same visit. Of those near to a true change but not next to
    it nothing is asked: poses are off by a centimetre.
    """
    parts = []
    for visit, seen, chances in (
        (Visit.FIRST, first, voxels.disappeared),
        (Visit.SECOND, second, voxels.appeared),
    ):
        asked = voxels.judged & (rows_of(voxels.keys, seen.keys) >= 0)
        keys = voxels.keys[asked]
        changed = near(keys, truth.decidable_keys(visit), MATCH)
        known = changed | ~near(keys, truth.surface, NEARBY)
        parts.append(Reliability.of(chances[asked][known].astype(np.float64), changed[known]))
    return Reliability.pooled(parts)
