"""Real scans: pairs whose transform is known, five frames of one room, and pairs that must not be joined.

The folder is not part of the project; its files are of the Point Cloud Library, libpointmatcher and an indoor
localisation study, under the names used here. The transforms were found by other registration programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from worker.benchmarks.registration.stage_clock import StageClock
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.errors import PipelineError
from worker.pipeline.flow import BuiltMap, build_map
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True, slots=True)
class Pair:
    """Two files of one place, below the folder."""

    name: str
    first: str
    second: str
    transform: str  #: text file, (4, 4) first_from_second


PAIRS = (
    Pair(
        name="room_scan",
        first="room_scan/room_scan1.pcd",
        second="room_scan/room_scan2.pcd",
        transform="room_scan/T_scan2_to_scan1.txt",
    ),
    Pair(
        name="corridor_pair",
        first="corridor_pair/cloud_0.ply",
        second="corridor_pair/cloud_1.ply",
        transform="corridor_pair/T_cloud1_to_cloud0.txt",
    ),
    Pair(
        name="ipad 808",
        first="ipad_rooms/pix4d_database_808_db.ply",
        second="ipad_rooms/pix4d_user_808_user.ply",
        transform="ipad_rooms/T_user_to_db_808.txt",
    ),
    Pair(
        name="ipad 560",
        first="ipad_rooms/pix4d_database_560_db.ply",
        second="ipad_rooms/pix4d_user_560_user.ply",
        transform="ipad_rooms/T_user_to_db_560.txt",
    ),
)
FRAMES = tuple(f"kinect_pairwise/capture000{number}.pcd" for number in range(1, 6))
FOREIGN = (
    ("room_scan/room_scan1.pcd", "corridor_pair/cloud_0.ply"),
    ("room_scan/room_scan1.pcd", "kinect_pairwise/capture0001.pcd"),
    ("ipad_rooms/pix4d_database_808_db.ply", "ipad_rooms/pix4d_database_560_db.ply"),
    ("ipad_rooms/pix4d_user_808_user.ply", "room_scan/room_scan2.pcd"),
)


def evaluate_real(folder: Path, progress: Progress = no_progress) -> dict[str, Any]:
    """Build each map without any prior; JSON-ready. Raises OSError where a file is missing."""
    return {
        "pairs": [_pair(folder, pair, progress) for pair in PAIRS],
        "frames": _frames(folder, progress),
        "foreign": [_foreign(folder, names, progress) for names in FOREIGN],
    }


def _pair(folder: Path, pair: Pair, progress: Progress) -> dict[str, Any]:
    given = np.loadtxt(folder / pair.transform)
    built, seconds = _built(folder, (pair.first, pair.second), progress)
    found = None if built is None else _relative(built, 0, 1)
    if found is None:
        return {"name": pair.name, "joined": False, "seconds": seconds}
    metres, radians = difference(given, found)
    return {
        "name": pair.name,
        "joined": True,
        "centimetres": 100 * metres,
        "degrees": float(np.degrees(radians)),
        "seconds": seconds,
        **_fit(built),
    }


def _frames(folder: Path, progress: Progress) -> dict[str, Any]:
    """Five frames to one map, and each pair of neighbours alone: the same relative poses?"""
    built, seconds = _built(folder, FRAMES, progress)
    accepted = sum(outcome.placement is not None for outcome in built.outcomes) if built else 0
    off = []
    for number, names in enumerate(pairwise(FRAMES)):
        alone, _ = _built(folder, names, progress)
        together = _relative(built, number, number + 1) if built else None
        apart = _relative(alone, 0, 1) if alone else None
        if together is not None and apart is not None:
            off.append(difference(together, apart))
    return {
        "name": "kinect_pairwise",
        "frames": len(FRAMES),
        "accepted": accepted,
        "pairs_compared": len(off),
        "centimetres_worst": 100 * max((metres for metres, _ in off), default=0.0),
        "degrees_worst": float(np.degrees(max((radians for _, radians in off), default=0.0))),
        "seconds": seconds,
        **_fit(built),
    }


def _foreign(folder: Path, names: tuple[str, str], progress: Progress) -> dict[str, Any]:
    built, seconds = _built(folder, names, progress)
    joined = built is not None and _relative(built, 0, 1) is not None
    return {"names": [Path(name).name for name in names], "joined": joined, "seconds": seconds}


def _built(folder: Path, names: Sequence[str], progress: Progress) -> tuple[BuiltMap | None, float]:
    """None where nothing of the files makes a map."""
    clock = StageClock(progress, prefix=f"{Path(names[0]).stem}: ")
    files = [ScanFile(name=Path(name).name, path=folder / name) for name in names]
    try:
        built = build_map(files, settings=PipelineSettings(), progress=clock)
    except PipelineError:
        return None, clock.seconds()["total"]
    return built, clock.seconds()["total"]


def _relative(built: BuiltMap, first: int, second: int) -> Matrix4 | None:
    """first_from_second, None where one of them was left out."""
    one, other = built.outcomes[first].placement, built.outcomes[second].placement
    if one is None or other is None:
        return None
    relative: Matrix4 = inverse(one.map_from_scan) @ other.map_from_scan
    return relative


def _fit(built: BuiltMap | None) -> dict[str, Any]:
    """The mean over all that were fitted to something, which the scan that sets the frame was not."""
    outcomes = [] if built is None else built.outcomes
    fitness = [outcome.fitness for outcome in outcomes if outcome.fitness is not None]
    rmse = [outcome.inlier_rmse for outcome in outcomes if outcome.inlier_rmse is not None]
    return {
        "fitness": float(np.mean(fitness)) if fitness else None,
        "rmse_centimetres": 100 * float(np.mean(rmse)) if rmse else None,
    }
