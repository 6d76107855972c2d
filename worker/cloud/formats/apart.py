"""Formats that other people's decoders read, E57 and LAZ, in a process of their own.

A damaged file may crash a decoder in C++ or Rust, hold it, or make it ask for all memory there is; here that ends this
one process, and the file is refused. It knows nothing but two open files: the scan, and the one that it lays the columns
into. `python -m worker.cloud.formats.apart` is that process; it is told what to do on its standard input.
"""

from __future__ import annotations

import errno
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from worker.cloud.formats.e57 import Station, read_e57, read_stations
from worker.cloud.formats.fields import RawCloud
from worker.cloud.formats.las import read_las
from worker.cloud.formats.store import ColumnStore, stored_columns
from worker.cloud.types import Matrix4
from worker.errors import ScanError, ScanTooLarge

MEMORY = 3 * 1024**3 // 2  #: bytes that decoding may allocate; the columns lie in a file
LEAST_S, BYTES_A_SECOND, POINTS_A_SECOND = (
    60.0,
    1_000_000,
    100_000,
)  #: that a decoder has in any case, and by size
_ROOT = Path(__file__).resolve().parents[3]
_ERRORS = {kind.code: kind for kind in (ScanError, ScanTooLarge)}
_KEPT = ("PATH", "LD_LIBRARY_PATH", "LANG", "TMPDIR", "SYSTEMROOT")  # no secret of the worker's is among them

Format = Literal["e57", "las"]


@dataclass(frozen=True, kw_only=True, slots=True)
class StationEntry:
    """One scan of an E57, of those that hold points."""

    name: str
    n: int  #: points
    pose: Matrix4 | None  #: (4, 4) file_from_station; None where the file has none


def decoded_apart(path: Path, format: Format, *, max_points: int, station: int | None = None) -> RawCloud:
    """Decode a file in a process of its own; `station` chooses among those of an E57.

    Raises ScanError, ScanTooLarge, and OSError where the disk is full.
    """
    with tempfile.TemporaryFile() as columns, path.open("rb") as file:
        asked = {"format": format, "max_points": max_points, "station": station}
        told = _told(asked, file.fileno(), columns.fileno(), seconds=_seconds(path, max_points))
        return _raw_cloud(told, columns.fileno())


def decoded_here(path: Path, format: Format, *, max_points: int, station: int | None = None) -> RawCloud:
    """Do the same in this process, which may die of it: for those that exist for that."""
    with tempfile.TemporaryFile() as columns, path.open("rb") as file:
        asked = {"format": format, "max_points": max_points, "station": station}
        return _raw_cloud(_decoded(asked, file.fileno(), columns.fileno()), columns.fileno())


def stations_of(path: Path) -> tuple[StationEntry, ...]:
    """Return the scans of an E57 that hold points, read in a process of its own. Raises ScanError."""
    with path.open("rb") as file:
        told = _told({"format": "e57", "list": True}, file.fileno(), None, seconds=LEAST_S)
    return tuple(
        StationEntry(name=one["name"], n=one["n"], pose=_matrix(one["pose"])) for one in told["stations"]
    )


def _raw_cloud(told: dict[str, Any], columns: int) -> RawCloud:
    return RawCloud(
        columns=stored_columns(columns, n=told["n"], colors=told["colors"]),
        sensor_pose=np.eye(4),
        prior=_matrix(told["pose"]),
        tells_sensor=told["format"] == "e57",
        may_lie_anywhere=True,
    )


def _matrix(rows: list[list[float]] | None) -> Matrix4 | None:
    return None if rows is None else np.array(rows, np.float64)


def _seconds(path: Path, max_points: int) -> float:
    """Return how long a decoder has for a file."""
    return LEAST_S + path.stat().st_size / BYTES_A_SECOND + max_points / POINTS_A_SECOND


def _told(asked: dict[str, Any], file: int, columns: int | None, *, seconds: float) -> dict[str, Any]:
    """Have a process do what is asked; return what it told. Raises ScanError also where it ended without a word."""
    handles = (file,) if columns is None else (file, columns)
    environment = {name: os.environ[name] for name in _KEPT if name in os.environ}
    environment |= {"PYTHONPATH": str(_ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    request = {**asked, "file": file, "columns": columns, "seconds": int(seconds)}
    try:
        ended = subprocess.run(  # nosec B603 - this interpreter, with arguments of ours
            [sys.executable, "-P", "-m", "worker.cloud.formats.apart"],
            input=json.dumps(request).encode(),
            capture_output=True,
            pass_fds=handles,
            env=environment,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ScanError(
            f"it was not decoded within {seconds:.0f} s, so it is damaged; write it anew"
        ) from None
    try:
        answer: dict[str, Any] = json.loads(ended.stdout)
    except ValueError:
        raise ScanError(
            f"its decoder {_end(ended.returncode)}, so the file is damaged; write it anew"
        ) from None
    if "disk" in answer:
        raise OSError(errno.ENOSPC, "the disk is full")
    if "error" in answer:
        raise _ERRORS.get(answer["code"], ScanError)(answer["error"])
    return answer


def _end(status: int) -> str:
    """Say how a process ended."""
    if status >= 0:
        return f"ended with status {status}"
    if -status in (signal.SIGXCPU, signal.SIGKILL):
        return "was killed"
    return f"crashed ({signal.Signals(-status).name})"


def main() -> None:
    """Do what standard input asks, and tell what came of it on standard output."""
    asked = json.load(sys.stdin)
    _limit(asked["seconds"])
    try:
        answer = _decoded(asked, asked["file"], asked["columns"])
    except ScanError as error:
        answer = {"error": str(error), "code": error.code}
    except MemoryError:
        answer = {
            "error": "its points do not fit in memory; split or thin the scan",
            "code": ScanTooLarge.code,
        }
    except OSError as error:
        answer = {"disk": True} if error.errno in (errno.ENOSPC, errno.EDQUOT) else _damaged(error)
    except BaseException as error:  # a panic of Rust is no Exception
        answer = _damaged(error)
    sys.stdout.write(json.dumps(answer))
    sys.stdout.flush()
    os._exit(0)  # what a decoder would do at its end is of no use


def _damaged(error: BaseException) -> dict[str, Any]:
    words = (str(error).strip().splitlines() or [""])[0][:200]
    return {
        "error": f"it cannot be decoded ({type(error).__name__}: {words}); write it anew",
        "code": ScanError.code,
    }


def _limit(seconds: int) -> None:
    """Limit what this process may take."""
    import resource  # noqa: PLC0415 - not on every system

    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _decoded(asked: dict[str, Any], file: int, columns: int | None) -> dict[str, Any]:
    """Decode a file, or list its stations; return what the other process has to know."""
    if os.fstat(file).st_size == 0:
        raise ScanError("the file is empty (0 bytes); upload it again")
    buffer = mmap.mmap(file, 0, access=mmap.ACCESS_READ)
    if asked.get("list"):
        stations = read_stations(buffer)
        return {"stations": [{"name": one.name, "n": one.n, "pose": _rows(one.pose)} for one in stations]}
    if columns is None:
        raise ValueError("no file for the columns")
    store, pose = ColumnStore(columns), None
    if asked["format"] == "e57":
        station = _chosen(read_stations(buffer), asked["station"], asked["max_points"])
        read_e57(f"/proc/self/fd/{file}", station, store, max_points=asked["max_points"])
        pose = station.pose
    else:
        with os.fdopen(os.dup(file), "rb") as opened:
            read_las(opened, store, max_points=asked["max_points"])
    return {"format": asked["format"], "n": store.n, "colors": store.has_colors, "pose": _rows(pose)}


def _chosen(stations: tuple[Station, ...], number: int | None, max_points: int) -> Station:
    if number is not None:
        return stations[number]
    if len(stations) > 1:
        together = sum(station.n for station in stations)
        if together > max_points:
            raise ScanTooLarge(
                f"its {len(stations)} scans declare {together} points together, the limit is {max_points}; split or thin "
                "the file"
            )
        raise ScanError(
            f"it holds {len(stations)} scans, each from its own place of the sensor, and they could not all be read; "
            "write each into a file of its own"
        )
    return stations[0]


def _rows(pose: Matrix4 | None) -> list[list[float]] | None:
    return None if pose is None else [[float(value) for value in row] for row in pose]


if __name__ == "__main__":
    main()
