"""What lies beside a scan and says where and when it was taken: `hall.pose.json` or `hall.pose.txt` of `hall.ply`.

The text has `x y z qx qy qz qw` (metres, unit quaternion) or sixteen numbers row by row; what follows a `#` is a
comment. The JSON is an object of the names that POST /scans has, each of which may be left out:

    {"pose": [2.5, 0, 0.35, 0, 0, 0, 1], "frame": "map", "captured_at": "2026-03-01T12:00:00Z", "device_id": "robot-7"}
"""

from __future__ import annotations

import contextlib
import json
import re
from datetime import datetime
from pathlib import Path
from typing import Any

from service.poses import matrix_of, numbers_of, require_rigid, rows_of

SUFFIXES = (".pose.json", ".pose.txt")
NAMES = ("pose", "frame", "captured_at", "device_id")
_RFC3339 = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(\.\d+)?([Zz]|[+-]\d\d:\d\d)")


class SidecarError(Exception):
    """A sidecar that cannot be used; `str()` names it and what is wrong."""


def sidecar_of(scan: Path) -> Path | None:
    """Return the file beside a scan that tells of it; None where there is none. Raises SidecarError for two."""
    present = [path for suffix in SUFFIXES if (path := scan.with_name(scan.stem + suffix)).is_file()]
    if len(present) > 1:
        raise SidecarError(f"{present[0].name} and {present[1].name} both tell of {scan.name}; leave one")
    return present[0] if present else None


def read_sidecar(scan: Path) -> dict[str, Any]:
    """Return what the sidecar of a scan says, the pose as 4x4 rows; empty without one. Raises SidecarError."""
    path = sidecar_of(scan)
    if path is None:
        return {}
    try:
        if path.suffix == ".txt":
            return {"pose": _rigid(read_pose_text(path.read_text()))}
        return _from_json(_loaded(path.read_text()))
    except OSError as error:
        raise SidecarError(f"{path.name} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise SidecarError(f"{path.name} cannot be used: it is no text in UTF-8") from error
    except ValueError as error:
        raise SidecarError(f"{path.name} cannot be used: {error}") from error


def read_pose_text(text: str) -> list[list[float]]:
    """Return the pose of a text: JSON, or numbers with blanks or commas between. Raises ValueError."""
    if text.lstrip().startswith("["):
        return _matrix(_loaded(text))
    return matrix_of(numbers_of(" ".join(line.partition("#")[0] for line in text.splitlines())))


def _from_json(said: Any) -> dict[str, Any]:
    if not isinstance(said, dict):
        raise ValueError("it is no JSON object")
    unknown = sorted(set(said) - set(NAMES))
    if unknown:
        raise ValueError(f"{', '.join(map(repr, unknown))} is none of {', '.join(NAMES)}")
    known = {name: value for name, value in said.items() if value is not None}
    if "pose" in known:
        known["pose"] = _rigid(_matrix(known["pose"]))
    if "captured_at" in known:
        _require_instant(known["captured_at"])
    return known


def _loaded(text: str) -> Any:
    """Return a JSON value. Raises ValueError with the place where it is none."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"no valid JSON at line {error.lineno}, column {error.colno}") from error


def _rigid(rows: list[list[float]]) -> list[list[float]]:
    require_rigid(rows)
    return rows


def _require_instant(said: Any) -> None:
    if isinstance(said, str) and _RFC3339.fullmatch(said):
        with contextlib.suppress(ValueError):
            datetime.fromisoformat(said.upper())
            return
    raise ValueError(
        f"captured_at {said!r} is no date and time of RFC 3339 with its zone, such as 2026-03-01T12:00:00Z"
    )


def _matrix(value: Any) -> list[list[float]]:
    rows = rows_of(value)
    is_matrix = isinstance(rows, list) and len(rows) == 4
    if not is_matrix or any(not isinstance(row, list) or len(row) != 4 for row in rows):
        raise ValueError("a pose is four rows of four numbers, or x y z qx qy qz qw")
    if any(not isinstance(number, int | float) or isinstance(number, bool) for row in rows for number in row):
        raise ValueError("a pose has numbers alone")
    return [[float(number) for number in row] for row in rows]
