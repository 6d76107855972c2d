"""Overlap culling: which pairs of scans are worth an ICP (paper, Section 3.3.2).

By bounding boxes, distance of centroids and height, all under the pose priors. Each scan then proposes its likeliest
partners only: one scan needs a few good registrations, not all it could have.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from worker.cloud.poses import transformed
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.mapping.settings import MappingSettings

_SHARE = (5, 95)  # percentiles along each axis: a few far returns do not make a box


@dataclass(frozen=True, kw_only=True, slots=True)
class Extent:
    """Where a scan's points are, in a frame that all scans share."""

    low: Floats  #: (3,) metres
    high: Floats  #: (3,) metres
    centroid: Floats  #: (3,) metres

    @classmethod
    def of(cls, points: NDArray[Any], frame_from_scan: Matrix4) -> Self:
        """Measure points (N, 3), metres, scan frame."""
        there = transformed(points, frame_from_scan)
        low, high = np.percentile(there, _SHARE, axis=0)
        return cls(low=low, high=high, centroid=there.mean(axis=0))


def likely_pairs(
    extents: Mapping[int, Extent], settings: MappingSettings, *, partners: int | None = None
) -> list[tuple[int, int]]:
    """Return pairs (lower index, higher index), sorted; each scan proposes `partners` at most, else the settings'."""
    rank = overlap_rank(extents, settings)
    return best_pairs(sorted(extents), rank, settings.partners if partners is None else partners)


def overlap_rank(extents: Mapping[int, Extent], settings: MappingSettings) -> Floats:
    """Rank (S, S) how likely two scans see the same, 0..1, in the order of their indices; 0 where they are culled."""
    if not extents:
        return np.zeros((0, 0))
    ordered = [extents[index] for index in sorted(extents)]
    low, high, centroid = (
        np.stack([getattr(extent, name) for extent in ordered]) for name in ("low", "high", "centroid")
    )
    shared = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)  # (S, S, 3)
    volume = np.prod(np.maximum(high - low, 1e-3), axis=1)
    both = np.prod(np.maximum(shared, 0.0), axis=2)  # (S, S)
    overlap = both / np.minimum(volume[:, None], volume)
    apart = np.linalg.norm(centroid[:, None] - centroid, axis=2)
    likely = (
        (overlap >= settings.min_box_overlap)
        & (apart <= settings.max_centroid_distance)
        & (np.abs(centroid[:, None, 2] - centroid[:, 2]) <= settings.max_height_difference)
    )
    np.fill_diagonal(likely, False)
    # the two boxes' common part of what they cover together: one box inside another is no close relative
    rank: Floats = np.where(likely, both / (volume[:, None] + volume - both), 0.0)
    return rank


def best_pairs(indices: list[int], rank: Floats, partners: int) -> list[tuple[int, int]]:
    """Return each scan's `partners` of highest `rank` (S, S); a rank of 0 is no pair."""
    pairs = set()
    for row, index in enumerate(indices):
        for column in np.argsort(-rank[row], kind="stable")[:partners]:
            if rank[row, column] > 0:
                pairs.add((min(index, indices[column]), max(index, indices[column])))
    return sorted(pairs)
