"""Poses as people and robots write them: a 4x4 matrix, or a position and a quaternion. No library is needed for either.

A pose is map_from_sensor: it takes points from the sensor's axes to the frame that is named beside it, in metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

UNIT_TOLERANCE = 1e-3  #: of a quaternion's norm against 1; four decimals pass
MAX_TEXT = 4000  #: letters of a pose

#: How a frame may be called: as tf2 takes it, without blanks (REP 105 has `map`, `odom`, `base_link`, `earth`).
FRAME = r"^[A-Za-z][A-Za-z0-9_./-]{0,127}$"


def matrix_of(numbers: Sequence[float]) -> list[list[float]]:
    """Return the 4x4 matrix of `x y z qx qy qz qw` (metres, unit quaternion), or of 16 numbers row by row.

    Raises ValueError for another count, and for a quaternion whose norm is not 1.
    """
    if len(numbers) == 16:
        return [list(numbers[start : start + 4]) for start in range(0, 16, 4)]
    if len(numbers) != 7:
        raise ValueError(
            f"a pose of {len(numbers)} numbers; give 4x4 rows, 16 numbers row by row, or `x y z qx qy qz qw`"
        )
    return from_position_and_quaternion(*numbers)


def from_position_and_quaternion(
    x: float, y: float, z: float, qx: float, qy: float, qz: float, qw: float
) -> list[list[float]]:
    """Return the 4x4 matrix of a position in metres and a quaternion, in the order of geometry_msgs/Pose.

    Raises ValueError where the norm of the quaternion is further from 1 than `UNIT_TOLERANCE`.
    """
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if not abs(norm - 1) <= UNIT_TOLERANCE:  # NaN as well
        raise ValueError(
            f"the quaternion ({qx:g}, {qy:g}, {qz:g}, {qw:g}) has the norm {norm:.4g}, not 1; the order is "
            "x y z qx qy qz qw"
        )
    a, b, c, d = (part / norm for part in (qx, qy, qz, qw))
    return [
        [1 - 2 * (b * b + c * c), 2 * (a * b - c * d), 2 * (a * c + b * d), x],
        [2 * (a * b + c * d), 1 - 2 * (a * a + c * c), 2 * (b * c - a * d), y],
        [2 * (a * c - b * d), 2 * (b * c + a * d), 1 - 2 * (a * a + b * b), z],
        [0.0, 0.0, 0.0, 1.0],
    ]


def numbers_of(text: str) -> list[float]:
    """Return the numbers of a text, with blanks or commas between. Raises ValueError."""
    if len(text) > MAX_TEXT:
        raise ValueError(f"a pose of {len(text)} letters, more than {MAX_TEXT}")
    return [float(word) for word in text.replace(",", " ").split()]


def rows_of(value: Any) -> Any:
    """Return a list of 7 or 16 numbers as 4x4 rows; any other value passes, for who checks it next. Raises ValueError."""
    is_flat = isinstance(value, list | tuple) and all(
        isinstance(number, Real) and not isinstance(number, bool) for number in value
    )
    return matrix_of([float(number) for number in value]) if is_flat and value else value
