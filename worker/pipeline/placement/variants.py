"""Variants of a scan: what its file would hold had one thing been otherwise; scaled, mirrored, turned, or a part of it.

Made of the points as the file has them and prepared anew, so that voxels, normals and range images are those of a file
that says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from worker.cloud.formats.scan import Scan
from worker.cloud.types import Floats

#: Turns (3, 3) that put another axis of the file up than z, by its number: 1 to 3 is x, y, z; below zero it points down.
UP_AXES: Mapping[int, Floats] = {
    -3: np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
    2: np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    -2: np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    1: np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]),
    -1: np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]),
}


def up_axis(rotation: Floats) -> int:
    """Return the number (as in `UP_AXES`) of the axis that a rotation (3, 3) map_from_scan puts nearest to up."""
    up = rotation[2]  # of each axis of the scan, how far it points up in the map
    axis = int(np.abs(up).argmax())
    return (axis + 1) * (1 if up[axis] > 0 else -1)


def scaled(scan: Scan, factor: float) -> Scan:
    """Multiply all coordinates, the sensor's place among them."""
    pose = scan.sensor_pose.copy()
    pose[:3, 3] *= factor
    return replace(scan, points=(scan.points * np.float32(factor)).astype(np.float32), sensor_pose=pose)


def mirrored(scan: Scan) -> Scan:
    """Negate x; which axis it is makes no difference but a turn. Of the sensor's pose the place alone is mirrored."""
    pose = scan.sensor_pose.copy()
    pose[0, 3] *= -1
    return replace(scan, points=scan.points * np.array([-1, 1, 1], np.float32), sensor_pose=pose)


def turned(scan: Scan, turn: Floats) -> Scan:
    """Turn points and sensor by a rotation (3, 3) about the frame's origin."""
    pose = scan.sensor_pose.copy()
    pose[:3] = turn @ pose[:3]
    return replace(scan, points=(scan.points @ turn.T).astype(np.float32), sensor_pose=pose)


def part(scan: Scan, low: float, high: float) -> Scan:
    """Keep the points from one share (0..1) of the file to another: a span of time where a sensor wrote it."""
    first, last = (round(share * len(scan.points)) for share in (low, high))
    colors = None if scan.colors is None else scan.colors[first:last]
    return replace(scan, points=scan.points[first:last], colors=colors)
