"""Rigid transforms, all `target_from_source`, (4, 4) float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Floats, Matrix4


def transformed(points: NDArray[Any], target_from_source: Matrix4) -> Floats:
    """Points (N, 3) of the source frame, in the target frame; float64."""
    moved: Floats = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    return moved


def inverse(target_from_source: Matrix4) -> Matrix4:
    """`source_from_target`."""
    result = np.eye(4)
    result[:3, :3] = target_from_source[:3, :3].T
    result[:3, 3] = -result[:3, :3] @ target_from_source[:3, 3]
    return result


def exponential(twist: Floats) -> Matrix4:
    """Rotate by `twist[:3]` (axis times radians, Rodrigues' formula), then move by `twist[3:]` metres."""
    result = np.eye(4)
    angle = float(np.linalg.norm(twist[:3]))
    if angle > 1e-12:
        x, y, z = twist[:3] / angle
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        result[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    result[:3, 3] = twist[3:]
    return result


def difference(a: Matrix4, b: Matrix4) -> tuple[float, float]:
    """How far two transforms of the same frames are apart: metres, radians."""
    between = inverse(a) @ b
    # sin and cos both, because arccos alone cannot tell angles under 1e-8 apart
    sine = np.linalg.norm(between[:3, :3] - between[:3, :3].T) / (2 * np.sqrt(2))
    cosine = (np.trace(between[:3, :3]) - 1) / 2
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.arctan2(sine, cosine))
