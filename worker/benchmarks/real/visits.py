"""Visits: real scans in one frame, by known transforms or by the product's own registration, as two visits each.

The folder is not part of the project; docs/test-data.md says what lies in it and where that comes from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from worker.benchmarks.registration.real import FRAMES, PAIRS
from worker.cloud.poses import inverse, transformed
from worker.cloud.types import Floats, Matrix4, Points
from worker.cloud.visibility import ENOUGH, share_in_front
from worker.errors import PipelineError
from worker.pipeline.flow import build_map, locate_survey
from worker.pipeline.registration.results import ScanFile, ScanResult, with_carrier
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

Poses = Literal["given", "registered"]

#: A camera looks along z, y down; rows say where its axes are in a frame with z up.
_LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RealScan:
    """A scan of the folder in the frame of its place."""

    name: str
    points: Points  #: (N, 3) float32, metres
    sensor_origin: (
        Floats | None
    )  #: (3,) metres; None where the points cannot all have been seen from one place


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TwoVisits:
    """Scans that make the map, and those that survey it."""

    name: str
    place: str  #: which room it is
    first: tuple[RealScan, ...]
    second: tuple[RealScan, ...]
    poses: Poses = "given"

    @property
    def same(self) -> bool:
        """Whether the survey is made of scans of the map: nothing can have changed."""
        return {scan.name for scan in self.second} <= {scan.name for scan in self.first}

    @property
    def blind(self) -> bool:
        """Whether either visit has no scan whose sensor's place is known."""
        return any(all(scan.sensor_origin is None for scan in visit) for visit in (self.first, self.second))


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """Which files are taken for two visits."""

    name: str
    place: str
    first: tuple[str, ...]  #: files of the map, below the folder
    second: tuple[str, ...]  #: files of the survey


def _plans() -> tuple[Plan, ...]:
    plans = []
    for pair in PAIRS:
        files = (f"{pair.folder}/{pair.first}", f"{pair.folder}/{pair.second}")
        words = ("1", "2") if pair.name == "room_scan" else ("first", "second")
        for one, other in ((0, 1), (1, 0)):
            name = f"{pair.name}, {words[one]} to {words[other]}"
            plans.append(Plan(name=name, place=pair.name, first=(files[one],), second=(files[other],)))
        if pair.name == "room_scan":
            plans += [
                Plan(name=f"room_scan, 1 and 2 to {word}", place=pair.name, first=files, second=(file,))
                for word, file in zip(words, files, strict=True)
            ]
    plans.append(Plan(name="kinect, 1 to 4 to 5", place="kinect", first=FRAMES[:4], second=FRAMES[4:]))
    plans += [
        Plan(name=f"kinect, {row} to {row + 1}", place="kinect", first=(one,), second=(other,))
        for row, (one, other) in enumerate(pairwise(FRAMES), start=1)
    ]
    return tuple(plans)


PLANS = _plans()
PLACES = tuple(dict.fromkeys(plan.place for plan in PLANS))


def given_poses(
    folder: Path, places: Sequence[str] = PLACES, progress: Progress = no_progress
) -> dict[str, Matrix4]:
    """Return of each file of some places where it stands in the frame of its place, place_from_scan.

    Transforms lie beside the pairs; the frames of the Kinect are registered together, by us. Raises OSError where a
    file is missing, and PipelineError where the frames make no map.
    """
    poses: dict[str, Matrix4] = {}
    for pair in PAIRS:
        if pair.name not in places:
            continue
        poses[f"{pair.folder}/{pair.first}"] = np.eye(4)
        poses[f"{pair.folder}/{pair.second}"] = np.loadtxt(folder / pair.folder / pair.transform)
    if "kinect" not in places:
        return poses
    built = build_map(_files(folder, FRAMES), settings=PipelineSettings(), progress=progress)
    for name, outcome in zip(FRAMES, built.outcomes, strict=True):
        poses[name] = _LEVEL @ _map_from_scan(outcome)
    return poses


def visits_by(folder: Path, plan: Plan, poses: dict[str, Matrix4], how: Poses = "given") -> TwoVisits:
    """Read the files of a plan, less the carrier's returns, each visit's by itself. Raises ScanError, OSError."""
    return TwoVisits(
        name=plan.name,
        place=plan.place,
        first=_read(folder, plan.first, poses),
        second=_read(folder, plan.second, poses),
        poses=how,
    )


def registered_poses(folder: Path, plan: Plan, progress: Progress = no_progress) -> dict[str, Matrix4] | str:
    """Return where the product puts the files of a plan: the map's together, the survey's onto it.

    Files that it leaves out are not in it. Where it makes no map or finds no place for the survey, returns the reason.
    """
    settings = PipelineSettings()
    settings = settings.with_values(tiling=settings.tiling.with_values(min_points=1))
    try:
        built = build_map(_files(folder, plan.first), settings=settings, progress=progress)
        located = locate_survey(
            _files(folder, plan.second), built.reference, settings=settings, progress=progress
        )
    except PipelineError as reason:
        return str(reason)
    poses: dict[str, Matrix4] = {}
    for names, outcomes in ((plan.first, built.outcomes), (plan.second, located.outcomes)):
        for name, outcome in zip(names, outcomes, strict=True):
            if outcome.registration is not None:
                poses.setdefault(name, outcome.registration.map_from_scan)
    return poses


def relative(poses: dict[str, Matrix4], plan: Plan) -> Matrix4 | None:
    """Return first_from_second of the first files of both visits; None where one has no pose."""
    one, other = poses.get(plan.first[0]), poses.get(plan.second[0])
    return None if one is None or other is None else np.asarray(inverse(one) @ other)


def _files(folder: Path, names: Sequence[str]) -> tuple[ScanFile, ...]:
    return tuple(ScanFile(name=Path(name).name, path=folder / name) for name in names)


def _map_from_scan(outcome: ScanResult) -> Matrix4:
    if outcome.registration is None:
        raise PipelineError(f"{outcome.name} was left out of the frames' map: {outcome.reason}")
    return outcome.registration.map_from_scan


def _read(folder: Path, names: Sequence[str], poses: dict[str, Matrix4]) -> tuple[RealScan, ...]:
    settings = PipelineSettings()
    files = with_carrier(_files(folder, names), settings.carrier, max_points=settings.max_scan_points)
    scans = []
    for name, file in zip(names, files, strict=True):
        scan = file.read(max_points=settings.max_scan_points)
        origin = scan.sensor_pose[:3, 3]
        seen_from = share_in_front(scan.points, origin) >= ENOUGH
        scans.append(
            RealScan(
                name=file.name,
                points=transformed(scan.points, poses[name]).astype(np.float32),
                sensor_origin=transformed(origin[None], poses[name])[0] if seen_from else None,
            )
        )
    return tuple(scans)
