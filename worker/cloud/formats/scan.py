"""Scans: one upload as points, read strictly (docs/decisions/0003-reading-scans.md, 0035-e57-and-las.md).

The header is checked against the file's real size before anything is allocated, and what cannot be right
is refused with the numbers that show it. A scan is never repaired, except that missing returns are dropped, and
the few points that lie far from all others.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.apart import Format, decoded_apart, decoded_here
from worker.cloud.formats.e57 import looks_like_e57
from worker.cloud.formats.extent import SAMPLE, Extent
from worker.cloud.formats.fields import Columns, RawCloud, colors_of
from worker.cloud.formats.las import looks_like_las
from worker.cloud.formats.pcd import looks_like_pcd, read_pcd
from worker.cloud.formats.ply import looks_like_ply, read_ply
from worker.cloud.types import Bools, Colors, Floats, Matrix4, Points
from worker.errors import ScanError, ScanTooLarge

_AT_ONCE = 1_000_000  #: points checked and copied together


@dataclass(frozen=True, kw_only=True, slots=True)
class Scan:
    """The points of one file, all finite."""

    name: str  #: file name as the client gave it
    points: Points  #: (N, 3) float32, metres, scan frame
    colors: Colors | None  #: (N, 3) uint8
    sensor_pose: Matrix4  #: (4, 4) float64, scan_from_sensor; PCD's VIEWPOINT, otherwise identity
    n_dropped: int  #: points with NaN or inf that were left out
    n_far: int = 0  #: points far from all others that were left out
    farthest: float = 0.0  #: metres from the middle of the scan to the farthest of those
    offset: Floats = field(
        default_factory=lambda: np.zeros(3)
    )  #: (3,) metres, taken off the file's coordinates
    prior: Matrix4 | None = (
        None  #: (4, 4) float64, where the file says that the sensor stood, in a frame of its own
    )
    tells_sensor: bool = (
        True  #: False: its format cannot say where the sensor stood, the origin may be any place
    )


def read_scan(
    path: Path,
    *,
    name: str | None = None,
    max_points: int = 50_000_000,
    station: int | None = None,
    apart: bool = True,
) -> Scan:
    """Read a PLY, PCD, E57, LAS or LAZ file, told apart by content.

    `station` chooses among the scans of an E57, from 0 on; without it a file of several is refused. E57, LAS and LAZ are
    decoded in a process of their own, or where `apart` is False in this one, which may die of it.

    Raises ScanError, ScanTooLarge, ScanUnits or ScanFarAway; the message starts with `name` (default: the file's name).
    """
    name = path.name if name is None else name
    try:
        return _checked_scan(_decode(path, max_points, station=station, apart=apart), name)
    except ScanError as error:
        raise type(error)(f"{name}: {error}") from None
    except MemoryError:
        raise ScanTooLarge(f"{name}: its points do not fit in memory; split or thin the scan") from None


def _decode(path: Path, max_points: int, *, station: int | None, apart: bool) -> RawCloud:
    """Tell the format by the first bytes and decode the whole file."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            raise ScanError("the file is empty (0 bytes); copy or record it again")
        buffer = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    head = buffer[:256]
    if looks_like_ply(head):
        return read_ply(buffer, max_points=max_points)
    if looks_like_pcd(head):
        return read_pcd(buffer, max_points=max_points)
    others: dict[Format, bool] = {"e57": looks_like_e57(head), "las": looks_like_las(head)}
    for kind, is_it in others.items():
        if is_it:
            decode = decoded_apart if apart else decoded_here
            return decode(path, kind, max_points=max_points, station=station)
    raise ScanError(f"neither PLY, PCD, E57 nor LAS, it starts with {head[:16]!r}; upload one of these")


def _checked_scan(raw: RawCloud, name: str) -> Scan:
    """Drop missing returns and refuse what cannot be a scan of a building in metres.

    The columns are gone through a piece at a time, so that nothing is held beside them but what is returned.
    """
    finite = np.concatenate(
        [np.isfinite(_positions(raw.columns, piece)).all(axis=1) for piece in _pieces(raw)]
    )
    n = int(np.count_nonzero(finite))
    if not n:
        raise ScanError(f"no points are left: {len(finite)} declared, {len(finite)} of them NaN or inf")
    extent = Extent.of(_sampled(raw, finite, n), anywhere=raw.may_lie_anywhere)
    points = np.empty((n, 3), np.float32)
    colors: list[Colors | None] = []
    done = 0
    for piece in _pieces(raw):
        kept = finite[piece]
        positions = _positions(raw.columns, piece)[kept]
        near = extent.near(positions)
        kept[kept] = near  # rows of the file that stay
        points[done : done + int(np.count_nonzero(near))] = positions[near] - extent.offset
        done += int(np.count_nonzero(near))
        colors.append(_colors(raw.columns, piece, kept))
    return Scan(
        name=name,
        points=points[:done],
        colors=_joined(colors),
        sensor_pose=raw.sensor_pose,
        n_dropped=len(finite) - n,
        n_far=extent.n_far,
        farthest=extent.farthest,
        offset=extent.offset,
        prior=raw.prior,
        tells_sensor=raw.tells_sensor,
    )


def _pieces(raw: RawCloud) -> Iterator[slice]:
    """Yield the rows of the columns a piece at a time; one empty piece where there are none."""
    n = len(raw.columns["x"])
    return (slice(start, start + _AT_ONCE) for start in range(0, max(n, 1), _AT_ONCE))


def _positions(columns: Columns, rows: slice | NDArray[np.intp]) -> NDArray[np.floating[Any]]:
    """Return positions (K, 3) of some rows, in the file's type and this machine's byte order."""
    with np.errstate(invalid="ignore"):  # of a signalling NaN, which is no more than another one
        positions = np.stack([columns[axis][rows] for axis in "xyz"], axis=1)
    return positions.astype(positions.dtype.newbyteorder("="), copy=False)


def _sampled(raw: RawCloud, finite: Bools, n: int) -> NDArray[np.floating[Any]]:
    """Return positions (K, 3) of every so manieth of the `n` finite rows, 100,000 or up to twice as many."""
    step = max(1, n // SAMPLE)
    rows, before = [], 0
    for piece in _pieces(raw):
        there = np.flatnonzero(finite[piece])
        rows.append(there[-before % step :: step] + piece.start)
        before += len(there)
    return _positions(raw.columns, np.concatenate(rows))


def _colors(columns: Columns, piece: slice, kept: Bools) -> Colors | None:
    """Return the colours (K, 3) of the kept rows of a piece, or None."""
    return colors_of(
        {key: column[piece][kept] for key, column in columns.items() if key not in ("x", "y", "z")}
    )


def _joined(colors: Sequence[Colors | None]) -> Colors | None:
    """Join the colours of all pieces; None where one of them has none."""
    there = [part for part in colors if part is not None]
    return np.concatenate(there) if len(there) == len(colors) else None
