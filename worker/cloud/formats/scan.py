"""Scans: one upload as points, read strictly (docs/decisions/0003-reading-scans.md).

The header is checked against the file's real size before anything is allocated, and what cannot be right
is refused with the numbers that show it. A scan is never repaired, except that missing returns are dropped.
"""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.fields import FARTHEST, RawCloud, colors_of
from worker.cloud.formats.pcd import looks_like_pcd, read_pcd
from worker.cloud.formats.ply import looks_like_ply, read_ply
from worker.cloud.types import Colors, Matrix4, Points
from worker.errors import ScanError, ScanTooLarge, ScanUnits

LONGEST_SITE = 500.0  #: metres along one axis; an indoor scan that is longer is not in metres
SHORTEST_ROOM = 3.0  #: metres; what another unit would make of the extent has to be a room
_SAMPLE = 100_000  #: points that the extent is measured on


@dataclass(frozen=True, kw_only=True, slots=True)
class Scan:
    """The points of one file, all finite."""

    name: str  #: file name as the client gave it
    points: Points  #: (N, 3) float32, metres, scan frame
    colors: Colors | None  #: (N, 3) uint8
    sensor_pose: Matrix4  #: (4, 4) float64, scan_from_sensor; PCD's VIEWPOINT, otherwise identity
    n_dropped: int  #: points with NaN or inf that were left out


def read_scan(path: Path, *, name: str | None = None, max_points: int = 50_000_000) -> Scan:
    """Read a PLY or PCD file, told apart by content.

    Raises ScanError, ScanTooLarge or ScanUnits; the message starts with `name` (default: the file's name).
    """
    name = path.name if name is None else name
    try:
        return _checked_scan(_decode(path, max_points), name)
    except ScanError as error:
        raise type(error)(f"{name}: {error}") from None
    except MemoryError:
        raise ScanTooLarge(f"{name}: its points do not fit in memory; split or thin the scan") from None


def _decode(path: Path, max_points: int) -> RawCloud:
    """Tell the format by the first bytes and decode the whole file."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            raise ScanError("the file is empty (0 bytes); upload it again")
        buffer = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    head = buffer[:256]
    if looks_like_ply(head):
        return read_ply(buffer, max_points=max_points)
    if looks_like_pcd(head):
        return read_pcd(buffer, max_points=max_points)
    raise ScanError(f"neither PLY nor PCD, it starts with {head[:16]!r}; upload one of the two")


def _checked_scan(raw: RawCloud, name: str) -> Scan:
    """Drop missing returns and refuse what cannot be a scan of a building in metres."""
    positions = np.stack([raw.columns[axis] for axis in "xyz"], axis=1)  # (N, 3), the file's type
    positions = positions.astype(positions.dtype.newbyteorder("="), copy=False)
    finite = np.isfinite(positions).all(axis=1)  # (N,)
    n_dropped = len(finite) - int(np.count_nonzero(finite))
    if n_dropped == len(finite):
        raise ScanError(f"no points are left: {len(finite)} declared, {n_dropped} of them NaN or inf")
    columns = {key: column for key, column in raw.columns.items() if key not in ("x", "y", "z")}
    if n_dropped:
        positions = positions[finite]
        columns = {key: column[finite] for key, column in columns.items()}
    check_units(positions)
    _check_distance(positions)
    return Scan(
        name=name,
        points=np.ascontiguousarray(positions, np.float32),
        colors=colors_of(columns),
        sensor_pose=raw.sensor_pose,
        n_dropped=n_dropped,
    )


def check_units(positions: NDArray[np.floating[Any]]) -> None:
    """Raise ScanUnits when the cloud (N, 3) is longer than any building, as one in millimetres is.

    The extent is that of the middle 98% of the points on each axis, so that stray returns do not decide.
    """
    sample = positions[:: max(1, len(positions) // _SAMPLE)].astype(np.float64)
    low, high = np.percentile(sample / 2, [1, 99], axis=0)  # of halves, whose difference cannot overflow
    extent = 2 * float(np.max(high - low))
    if extent <= LONGEST_SITE:
        return
    span = f"it spans {extent:.6g} along one axis, over {LONGEST_SITE:g} m"
    for unit, factor in (("millimetres", 0.001), ("centimetres", 0.01)):  # the commoner one first
        if SHORTEST_ROOM <= extent * factor <= LONGEST_SITE:
            raise ScanUnits(f"{span}: looks like {unit}; multiply by {factor} to get metres")
    raise ScanUnits(f"{span}: not a scan of a building in metres; check its units")


def _check_distance(positions: NDArray[np.floating[Any]]) -> None:
    """Raise ScanError when a point (N, 3) lies too far away for float32 to keep its millimetres."""
    far = (np.abs(positions) > FARTHEST).any(axis=1)
    if far.any():
        first = int(np.argmax(far))
        where = ", ".join(f"{v:.6g}" for v in positions[first])
        raise ScanError(
            f"{int(np.count_nonzero(far))} of {len(far)} points lie over {FARTHEST:g} m from the origin, "
            f"one at ({where}); subtract the map's offset, and write missing returns as NaN"
        )
