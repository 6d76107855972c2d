"""Poses as people and robots write them: a 4x4 matrix, or a position and a quaternion. No library is needed for either.

A pose is map_from_sensor: it takes points from the sensor's axes to the frame that is named beside it, in metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

UNIT_TOLERANCE = 1e-3  #: of a quaternion's norm against 1; four decimals pass
RIGID_TOLERANCE = 1e-3  #: of R R^T against the identity; poses written with four decimals pass
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
    return [_number(word) for word in text.replace(",", " ").split()]


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{word[:40]!r} is no number") from None


def require_rigid(rows: Sequence[Sequence[float]]) -> None:
    """Check that 4x4 rows are a rotation and a shift, within `RIGID_TOLERANCE`. Raises ValueError that says what is off."""
    if any(not abs(a - b) <= 1e-6 for a, b in zip(rows[3], (0, 0, 0, 1), strict=True)):
        raise ValueError("the last row of a pose is 0, 0, 0, 1; the matrix is row-major")
    axes = [row[:3] for row in rows[:3]]
    gram = [[sum(x * y for x, y in zip(a, b, strict=True)) for b in axes] for a in axes]
    off = max(abs(gram[i][j] - (i == j)) for i in range(3) for j in range(3))
    if not off <= RIGID_TOLERANCE:  # NaN as well
        scales = [math.sqrt(gram[i][i]) for i in range(3)]
        skewed = max(abs(gram[i][j]) for i in range(3) for j in range(i)) > RIGID_TOLERANCE
        if skewed or max(scales) - min(scales) > RIGID_TOLERANCE:
            lengths = ", ".join(f"{scale:.4g}" for scale in scales)
            what = f"its rows have the lengths {lengths}" + (" and are not at right angles" if skewed else "")
        else:
            what = f"the matrix scales by {scales[0]:.4g}"
        raise ValueError(f"the pose is not rigid: {what}; its rotation part must be orthonormal")
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes
    if xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx) < 0:
        raise ValueError("the pose mirrors: its determinant is negative")


def rows_of(value: Any) -> Any:
    """Return a list of 7 or 16 numbers as 4x4 rows; any other value passes, for who checks it next. Raises ValueError."""
    is_flat = isinstance(value, list | tuple) and all(
        isinstance(number, Real) and not isinstance(number, bool) for number in value
    )
    return matrix_of([float(number) for number in value]) if is_flat and value else value
