"""Values that requests carry in more than one place, with their checks."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema

from service.api.http.answering.json_text import read_json
from service.catalog.records import Matrix
from service.poses import FRAME, numbers_of, require_rigid, rows_of

MAX_LISTED = 1000  #: names in one list of a request
LARGEST_SHIFT = 10_000.0  #: metres; further out the workers take no point of a scan either

_RFC3339 = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(\.\d+)?([Zz]|[+-]\d\d:\d\d)")


def instant(value: object) -> datetime:
    """Read an RFC 3339 date and time, zone included: a time without a zone is ambiguous. Raises ValueError."""
    if isinstance(value, datetime):
        return value
    if not isinstance(value, str) or not _RFC3339.fullmatch(value):
        raise ValueError("give an RFC 3339 date and time with its zone, such as 2026-03-01T12:00:00Z")
    try:
        return datetime.fromisoformat(value.upper()).astimezone(UTC)
    except OverflowError as error:
        raise ValueError("the time is outside the years 1 to 9999 in UTC") from error


def readable(read: Callable[[str], object]) -> AfterValidator:
    """Check a text with `read`, and leave it a text: a query parameter of many parts is taken for a list."""

    def check(text: str) -> str:
        read(text)
        return text

    return AfterValidator(check)


def from_text(value: Any) -> Any:
    """Read a form field or query parameter that holds JSON; other values pass."""
    if not isinstance(value, str):
        return value
    try:
        return read_json(value)
    except ValueError as error:
        raise ValueError(f"this is not JSON: {error}") from error


def pose_from_text(value: Any) -> Any:
    """Read a pose: 4x4 rows, 16 numbers, or `x y z qx qy qz qw`, as JSON or with blanks between. Raises ValueError."""
    if isinstance(value, str) and not value.lstrip().startswith(("[", "{")):
        try:
            value = numbers_of(value)
        except ValueError as error:
            raise ValueError(f"this is not JSON, nor numbers with blanks between: {error}") from error
        if not value:
            raise ValueError("the pose is empty; leave it out, or give `x y z qx qy qz qw`")
    return rows_of(from_text(value))


def names_from_text(value: Any) -> Any:
    """Read a list of names in a form: repeated fields, a JSON list, or names with commas between.

    Raises ValueError for more than `MAX_LISTED`, before any of them is looked at.
    """
    if isinstance(value, str):
        if value.lstrip().startswith("["):
            value = from_text(value)
        else:
            value = [name.strip() for name in value.split(",") if name.strip()]
    if isinstance(value, list) and len(value) > MAX_LISTED:
        raise ValueError(f"a list of {len(value)} names, more than {MAX_LISTED}")
    return value


def rigid(matrix: Matrix) -> Matrix:
    """Check that a matrix is a rotation and a shift. Raises ValueError with the number that is off."""
    require_rigid(matrix)
    shift = math.hypot(*(row[3] for row in matrix[:3]))
    if shift > LARGEST_SHIFT:
        raise ValueError(
            f"the pose shifts by {shift:.0f} m, more than {LARGEST_SHIFT:.0f} m; give it in metres, and in a "
            "frame whose origin lies at the building"
        )
    return matrix


_POSE_SCHEMA = {
    "anyOf": [
        {
            "type": "array",
            "description": "4x4, row-major",
            "minItems": 4,
            "maxItems": 4,
            "items": {"type": "array", "minItems": 4, "maxItems": 4, "items": {"type": "number"}},
        },
        {
            "type": "array",
            "description": "x y z qx qy qz qw: metres, and a unit quaternion",
            "minItems": 7,
            "maxItems": 7,
            "items": {"type": "number"},
        },
    ],
    "example": [[1, 0, 0, 2.5], [0, 1, 0, 0], [0, 0, 1, 0.35], [0, 0, 0, 1]],
}

ID = r"^[A-Za-z0-9_-]{1,64}$"
Id = Annotated[str, Field(pattern=ID, examples=["lobby"])]
ScanId = Annotated[str, Field(pattern=ID, examples=["scan-2b1f"])]
Instant = Annotated[
    datetime,
    BeforeValidator(instant),
    WithJsonSchema({"type": "string", "format": "date-time", "example": "2026-03-01T12:00:00Z"}),
]
Pose = Annotated[Matrix, BeforeValidator(pose_from_text), AfterValidator(rigid), WithJsonSchema(_POSE_SCHEMA)]
Frame = Annotated[str, Field(pattern=FRAME, examples=["map"])]
Text = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]*$")]  #: one line; PostgreSQL takes no NUL
DeviceId = Annotated[Text, Field(min_length=1, max_length=128, examples=["robot-7"])]
Model = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*/[A-Za-z0-9][A-Za-z0-9_.-]*$", examples=["voxel-net/1"])
]
