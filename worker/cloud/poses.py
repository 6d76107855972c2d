"""Rigid transforms, all `target_from_source`, (4, 4) float64."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from worker.cloud.types import Floats, Matrix4

_AT_ONCE = 1_000_000  # points that are moved together


def transformed(points: NDArray[Any], target_from_source: Matrix4) -> Floats:
    """Return points (N, 3) of the source frame in the target frame; float64."""
    if len(points) <= _AT_ONCE:
        small: Floats = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
        return small
    moved = np.empty((len(points), 3))
    for start in range(0, len(points), _AT_ONCE):  # the sum takes three times the memory of its result
        moved[start : start + _AT_ONCE] = transformed(points[start : start + _AT_ONCE], target_from_source)
    return moved


def inverse(target_from_source: Matrix4) -> Matrix4:
    """Return source_from_target."""
    result = np.eye(4)
    result[:3, :3] = target_from_source[:3, :3].T
    result[:3, 3] = -result[:3, :3] @ target_from_source[:3, 3]
    return result


def translation(offset: Floats) -> Matrix4:
    """Return the transform that moves points by `offset` (3,) metres."""
    result = np.eye(4)
    result[:3, 3] = offset
    return result


def exponential(twist: Floats) -> Matrix4:
    """Rotate by `twist[:3]` (axis times radians, Rodrigues' formula), then move by `twist[3:]` metres."""
    result = np.eye(4)
    angle = float(np.linalg.norm(twist[:3]))
    if angle > 1e-12:
        cross = skew(twist[:3] / angle)
        result[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    result[:3, 3] = twist[3:]
    return result


def skew(vector: Floats) -> Floats:
    """Return the (3, 3) matrix of the cross product with a vector (3,)."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def adjoint(pose: Matrix4) -> Floats:
    """Return the (6, 6) that writes a twist (rotation, translation) of one frame as the same motion in another."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = pose[:3, :3]
    result[3:, :3] = skew(pose[:3, 3]) @ pose[:3, :3]
    return result


def difference(a: Matrix4, b: Matrix4) -> tuple[float, float]:
    """Measure how far two transforms of the same frames are apart: metres, radians."""
    between = inverse(a) @ b
    # sin and cos both, because arccos alone cannot tell angles under 1e-8 apart
    sine = np.linalg.norm(between[:3, :3] - between[:3, :3].T) / (2 * np.sqrt(2))
    cosine = (np.trace(between[:3, :3]) - 1) / 2
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.arctan2(sine, cosine))


def rigid_fit(source_points: Floats, target_points: Floats) -> Matrix4:
    """Return the target_from_source of least squares between paired points, (N, 3) each (Kabsch 1976)."""
    source_mean, target_mean = source_points.mean(axis=0), target_points.mean(axis=0)
    rotation, _ = Rotation.align_vectors(target_points - target_mean, source_points - source_mean)
    result = np.eye(4)
    result[:3, :3] = rotation.as_matrix()
    result[:3, 3] = target_mean - result[:3, :3] @ source_mean
    return result


def fit_poses(source: Sequence[Matrix4], target: Sequence[Matrix4], *, arm: float) -> Matrix4:
    """Return the rigid motion that brings each source pose nearest to its target pose.

    A pose counts as four points: its place, and the ends of its axes at `arm` metres, so that places on one line
    leave no turn free.
    """
    corners = np.vstack([np.zeros(3), arm * np.eye(3)])
    source_points, target_points = (
        np.concatenate([transformed(corners, pose) for pose in poses]) for poses in (source, target)
    )
    return rigid_fit(source_points, target_points)
