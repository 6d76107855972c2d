"""Writer of LAZ 1.4: points in steps of a millimetre, colours of 16 bits, and one extra value a point for each scalar."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Colors, Points
from worker.files import write_atomically

_STEP = 0.001  #: metres; a tenth of what a LiDAR measures to
_AT_ONCE = 1_000_000  #: points written together
_FULL = 257  #: times a colour of 8 bits is the one of 16, so that white stays white
_KINDS = {"b": "u1", "u1": "u1", "f": "f4", "i": "i4"}


def write_laz(
    path: Path,
    points: Points,
    *,
    colors: Colors | None = None,
    scalars: Mapping[str, NDArray[Any]] | None = None,
    meanings: Mapping[str, str] | None = None,
) -> None:
    """Write points (N, 3), metres, as LAZ 1.4 of point format 7, or 6 without colours.

    A scalar `name` (N,) becomes the extra bytes of that name (LAS 1.4 - R15, table 25): bool and uint8 as unsigned
    char, other integers as long, floats as float; the first 31 letters of its meaning stand beside it. The file appears
    whole or not at all. Raises ValueError for a scalar whose length is not N.
    """
    columns = {name: _narrow(np.asarray(values)) for name, values in (scalars or {}).items()}
    if any(column.shape != (len(points),) for column in columns.values()):
        raise ValueError(f"scalars of {[len(c) for c in columns.values()]} values for {len(points)} points")
    write_atomically(path, lambda aside: _write(aside, points, colors, columns, meanings or {}))


def _write(
    path: Path,
    points: Points,
    colors: Colors | None,
    columns: Mapping[str, NDArray[Any]],
    meanings: Mapping[str, str],
) -> None:
    import laspy  # noqa: PLC0415 - the steps that write none need not load it

    header = laspy.LasHeader(point_format=6 if colors is None else 7, version="1.4")
    header.scales, header.offsets = np.full(3, _STEP), np.zeros(3)
    header.global_encoding.wkt = True  # point formats from 6 on have it so
    header.generating_software, header.system_identifier = "SPICD", "SPICD"
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                name=name, type=column.dtype.str[1:], description=meanings.get(name, "")[:31]
            )
            for name, column in columns.items()
        ]
    )
    with path.open("wb") as file:
        backend = laspy.LazBackend.Lazrs
        with laspy.open(
            file, "w", header=header, do_compress=True, laz_backend=backend, closefd=False
        ) as laz:
            for piece in _pieces(len(points)):
                rows = laspy.ScaleAwarePointRecord.zeros(piece.stop - piece.start, header=header)
                rows["X"], rows["Y"], rows["Z"] = (
                    np.rint(points[piece].astype(np.float64) / _STEP).astype(np.int32).T
                )
                rows["return_number"] = rows["number_of_returns"] = np.ones(len(points[piece]), np.uint8)
                if colors is not None:
                    rows["red"], rows["green"], rows["blue"] = (colors[piece].astype(np.uint16) * _FULL).T
                for name, column in columns.items():
                    rows[name] = column[piece]
                laz.write_points(rows)


def _pieces(n: int) -> Iterator[slice]:
    return (slice(start, min(start + _AT_ONCE, n)) for start in range(0, n, _AT_ONCE))


def _narrow(values: NDArray[Any]) -> NDArray[Any]:
    """Return the values as uint8, int32 or float32."""
    kind = "u1" if values.dtype == np.uint8 else values.dtype.kind
    return values.astype(_KINDS.get(kind, "i4"))
