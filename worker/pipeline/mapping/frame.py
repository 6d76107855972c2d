"""Which frame a map gets: that of the robots' own poses, as well as one rigid motion can meet them all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from worker.cloud.poses import inverse
from worker.cloud.types import Matrix4

ENOUGH_PRIORS = 3  #: from which the error of one is outweighed
_LEVER = 2.0  # metres at which a prior's direction counts as much as its place


def map_from_reference(
    poses: Mapping[int, Matrix4], priors: Mapping[int, Matrix4], reference: int
) -> Matrix4:
    """The frame of the priors, from that of the reference scan.

    `poses` are reference_from_scan, `priors` map_from_scan as far as they are known. With three or more the motion of
    least squares to all (Kabsch 1976), for one scan's heading may be degrees off; with fewer the reference's prior,
    else the first there is, else identity.
    """
    known = [scan for scan in poses if scan in priors]
    if not known:
        return np.eye(4)
    if len(known) < ENOUGH_PRIORS:
        scan = reference if reference in known else known[0]
        pose: Matrix4 = priors[scan] @ inverse(poses[scan])
        return pose
    return fitted([poses[scan] for scan in known], [priors[scan] for scan in known])


def fitted(sources: list[Matrix4], targets: list[Matrix4]) -> Matrix4:
    """The rigid motion that brings each source pose nearest to its target pose, by least squares."""
    # a pose as four points: its place, and the ends of its axes
    corners = np.c_[np.vstack([np.zeros(3), _LEVER * np.eye(3)]), np.ones(4)]
    a = np.concatenate([corners @ pose[:3].T for pose in sources])
    b = np.concatenate([corners @ pose[:3].T for pose in targets])
    left, _, right = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    motion = np.eye(4)
    motion[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    motion[:3, 3] = b.mean(axis=0) - motion[:3, :3] @ a.mean(axis=0)
    return motion
