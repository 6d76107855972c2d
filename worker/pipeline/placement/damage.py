"""Damage: a file whose points are no scan at all, told by the points alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.cloud.voxels import Voxels
from worker.threads import query_threads

_SAMPLE = 50_000  # points looked at, evenly over the file
LEAST_DISTINCT = 0.3  #: share of the points; real scans have 0.82 to 1.00, points rounded to a metre 0.00
MOST_IN_ONE = 0.5  #: share of the points in one voxel; real scans have up to 0.04
#: 0 is a plane, 0.16 points strewn evenly: real scans have 0.003 to 0.072, a storey merged of many 0.08, a scan half of
#: which was replaced by noise 0.11 to 0.13
MOST_SCATTERED = 0.1
_VOXEL = 0.05  # metres; finer than this a scan's noise is no surface
_NEIGHBOURS = 12
_LOOKED_AT = 4000  # voxels whose neighbours are asked


@dataclass(frozen=True, kw_only=True, slots=True)
class Damage:
    """What shows that points are no scan."""

    detail: str  #: what they do, after "scan hall.pcd: "
    numbers: dict[str, float]  #: shares in 0..1


def damage_of(points: NDArray[Any]) -> Damage | None:
    """Tell whether most points (N, 3), metres, lie on each other, alone, or strewn through space; None where not."""
    sample = points[:: max(1, len(points) // _SAMPLE)]
    if not len(sample):
        return None
    distinct = len(np.unique(sample, axis=0)) / len(sample)
    voxels = Voxels.of(sample - np.median(sample, axis=0), size=_VOXEL)
    fullest = float(voxels.counts.max() / len(sample))
    if distinct < LEAST_DISTINCT or fullest > MOST_IN_ONE:
        return Damage(
            detail=f"its points lie on each other ({distinct:.0%} of them are distinct, one voxel holds {fullest:.0%})",
            numbers={"distinct": distinct, "fullest": fullest},
        )
    spread = _scatter(voxels.points)
    if spread > MOST_SCATTERED:
        return Damage(
            detail=f"its points lie on no surfaces (scatter {spread:.2f}, a scan has up to {MOST_SCATTERED:g})",
            numbers={"scatter": spread},
        )
    return None


def _scatter(points: NDArray[Any]) -> float:
    """Return the median surface variation: least eigenvalue of a neighbourhood's scatter over their sum, 0..1/3.

    Of the twelve nearest voxels, whatever their distance; Pauly, Gross and Kobbelt, IEEE Visualization 2002.
    """
    if len(points) <= _NEIGHBOURS:
        return 0.0
    asked = points[:: max(1, len(points) // _LOOKED_AT)]
    _, index = cKDTree(points).query(asked, k=_NEIGHBOURS, workers=query_threads())
    around = points[index].astype(np.float64)  # (K, 12, 3)
    around -= around.mean(axis=1, keepdims=True)
    eigenvalues = np.linalg.eigvalsh(around.transpose(0, 2, 1) @ around)
    return float(np.median(eigenvalues[:, 0] / np.maximum(eigenvalues.sum(axis=1), 1e-12)))
