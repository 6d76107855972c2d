"""Estimated poses laid over the true ones: a map's frame is free, so errors are counted after the best fit.

That is the absolute trajectory error of Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems"
(IROS 2012), with Horn's closed form; the fit here is made over the scans that agree with each other, so that
one wrong pose shows its whole error and bends no other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from worker.cloud.poses import fit_poses, inverse, transformed
from worker.cloud.types import Bools, Floats, Matrix4

ARM = 1.0  #: metres along each axis of a pose; with these tips even stops on one line leave no turn free
WRONG = 0.1  #: metres; a pose that is off by this is wrong
_SPREAD = 3.0  # times the median error: what lies farther off has no say
_ROUNDS = 10


def align(estimated: Sequence[Matrix4], true: Sequence[Matrix4]) -> Matrix4:
    """(4, 4) true_from_estimated, rigid, over the inliers of a first fit; up to half of the poses may be wrong.

    The two hold the same sensors' poses, in the same order. Raises ValueError where there are none.
    """
    if len(estimated) != len(true) or not true:
        raise ValueError(f"{len(estimated)} poses cannot be laid over {len(true)}")
    found = _by_one_pose(estimated, true)
    inliers: Bools | None = None
    for _ in range(_ROUNDS):
        off = distances(found, estimated, true)
        now = off <= max(_SPREAD * _lower_median(off), WRONG)
        if inliers is not None and np.array_equal(now, inliers):
            break
        inliers = now
        chosen = np.flatnonzero(now).tolist()
        found = fit_poses([estimated[index] for index in chosen], [true[index] for index in chosen], arm=ARM)
    return found


def distances(true_from_estimated: Matrix4, estimated: Sequence[Matrix4], true: Sequence[Matrix4]) -> Floats:
    """(N,) metres between each estimated position, once aligned, and the true one."""
    there = transformed(np.stack([pose[:3, 3] for pose in estimated]), true_from_estimated)
    off: Floats = np.linalg.norm(there - np.stack([pose[:3, 3] for pose in true]), axis=1)
    return off


def _by_one_pose(estimated: Sequence[Matrix4], true: Sequence[Matrix4]) -> Matrix4:
    """Every single pose fixes a frame; the one in which the median of the others is least."""
    frames = [there @ inverse(here) for here, there in zip(estimated, true, strict=True)]
    return min(frames, key=lambda frame: _lower_median(distances(frame, estimated, true)))


def _lower_median(off: Floats) -> float:
    """Of two in the middle the lower: half of the poses have to agree, no more."""
    return float(np.sort(off)[(len(off) - 1) // 2])
