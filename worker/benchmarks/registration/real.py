"""Real scans: pairs whose transform is known, five frames of one room, and pairs that must not be joined.

The folder is not part of the project; its files are of the Point Cloud Library, libpointmatcher and an indoor
localisation study, under the names used here. The transforms were found by other registration programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from worker.benchmarks.documents import Document
from worker.benchmarks.timing import StageClock
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.errors import PipelineError
from worker.pipeline.flow import BuiltMap, build_map
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress


@dataclass(frozen=True, slots=True)
class RealPair:
    """Two files of one place, in a folder of their own."""

    name: str
    folder: str
    first: str
    second: str
    transform: str  #: text file, (4, 4) first_from_second


PAIRS = (
    RealPair("room_scan", "room_scan", "room_scan1.pcd", "room_scan2.pcd", "T_scan2_to_scan1.txt"),
    RealPair("corridor_pair", "corridor_pair", "cloud_0.ply", "cloud_1.ply", "T_cloud1_to_cloud0.txt"),
    *(
        RealPair(
            f"ipad {room}",
            "ipad_rooms",
            f"pix4d_database_{room}_db.ply",
            f"pix4d_user_{room}_user.ply",
            f"T_user_to_db_{room}.txt",
        )
        for room in (808, 560)
    ),
)
FRAMES = tuple(f"kinect_pairwise/capture000{number}.pcd" for number in range(1, 6))
OUT_OF_PLACE = (
    ("room_scan/room_scan1.pcd", "corridor_pair/cloud_0.ply"),
    ("room_scan/room_scan1.pcd", "kinect_pairwise/capture0001.pcd"),
    ("ipad_rooms/pix4d_database_808_db.ply", "ipad_rooms/pix4d_database_560_db.ply"),
    ("ipad_rooms/pix4d_user_808_user.ply", "room_scan/room_scan2.pcd"),
)


def evaluate_real(folder: Path, progress: Progress = no_progress) -> Document:
    """Build each map without any prior; JSON-ready. Raises OSError where a file is missing."""
    return {
        "pairs": [_pair(folder, pair, progress) for pair in PAIRS],
        "frames": _frames(folder, progress),
        "foreign": [_out_of_place(folder, names, progress) for names in OUT_OF_PLACE],
    }


def _pair(folder: Path, pair: RealPair, progress: Progress) -> Document:
    given = np.loadtxt(folder / pair.folder / pair.transform)
    built, seconds = _built(folder / pair.folder, (pair.first, pair.second), progress)
    first_from_second = None if built is None else _relative(built, 0, 1)
    if first_from_second is None:
        return {"name": pair.name, "joined": False, "seconds": seconds}
    metres, radians = difference(given, first_from_second)
    return {
        "name": pair.name,
        "joined": True,
        "centimetres": 100 * metres,
        "degrees": float(np.degrees(radians)),
        "seconds": seconds,
        **_fit(built),
    }


def _frames(folder: Path, progress: Progress) -> Document:
    """Build one map of five frames, and one of each pair of neighbours, to compare their relative poses."""
    built, seconds = _built(folder, FRAMES, progress)
    accepted = sum(outcome.registration is not None for outcome in built.outcomes) if built else 0
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


def _out_of_place(folder: Path, names: tuple[str, str], progress: Progress) -> Document:
    built, seconds = _built(folder, names, progress)
    joined = built is not None and _relative(built, 0, 1) is not None
    return {"names": [Path(name).name for name in names], "joined": joined, "seconds": seconds}


def _built(folder: Path, names: Sequence[str], progress: Progress) -> tuple[BuiltMap | None, float]:
    """Build a map of the files, None where nothing of them makes one; and the seconds that it took."""
    clock = StageClock(progress, prefix=f"{Path(names[0]).stem}: ")
    files = [ScanFile(name=Path(name).name, path=folder / name) for name in names]
    try:
        built = build_map(files, settings=PipelineSettings(), progress=clock)
    except PipelineError:
        return None, clock.seconds()["total"]
    return built, clock.seconds()["total"]


def _relative(built: BuiltMap, first: int, second: int) -> Matrix4 | None:
    """Return first_from_second, None where one of them was left out."""
    one, other = built.outcomes[first].registration, built.outcomes[second].registration
    if one is None or other is None:
        return None
    relative: Matrix4 = inverse(one.map_from_scan) @ other.map_from_scan
    return relative


def _fit(built: BuiltMap | None) -> Document:
    """Average over all that were fitted to something, which the scan that sets the frame was not."""
    outcomes = [] if built is None else built.outcomes
    fitness = [outcome.fitness for outcome in outcomes if outcome.fitness is not None]
    rmse = [outcome.inlier_rmse for outcome in outcomes if outcome.inlier_rmse is not None]
    return {
        "fitness": float(np.mean(fitness)) if fitness else None,
        "rmse_centimetres": 100 * float(np.mean(rmse)) if rmse else None,
    }
