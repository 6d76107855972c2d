"""Chaining: several scans placed in one frame, one after the other (Stage 1, the plain form).

Each scan is registered to what is fused so far, starting from its pose prior; the paper's pose graph
(Section 3.3.2) is a later step and takes this file's place.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worker.errors import MapFailed
from worker.pipeline.icp import Surface
from worker.pipeline.poses import inverse
from worker.pipeline.registration import (
    RegisteredScan,
    ScanRejected,
    as_reference,
    register,
    source_surface,
    surface_of,
)
from worker.pipeline.registration_settings import RegistrationSettings
from worker.pipeline.scan import Scan, read_scan
from worker.pipeline.values import Matrix4
from worker.pipeline.voxels import Voxels
from worker.progress import Progress, silent


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanFile:
    """A scan, to be read when it is needed."""

    name: str  #: what messages call it
    path: Path
    pose: Matrix4 | None = None  #: (4, 4) map_from_sensor as the client believes it, e.g. by odometry

    def read(self, *, max_points: int) -> Scan:
        """Raises ScanError, whose message names the file."""
        return read_scan(self.path, name=self.name, max_points=max_points)


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What became of one scan: placed, or left out with a reason."""

    name: str
    scan: RegisteredScan | None
    reason: str | None = None
    fitness: float | None = None  #: 0..1, the best reached; None where there was nothing to fit to
    inlier_rmse: float | None = None  #: metres


def place(
    file: ScanFile,
    target: Surface,
    *,
    settings: RegistrationSettings,
    max_points: int,
    tick: Callable[[], None] = lambda: None,
) -> Outcome:
    """Read a scan and register it to the target; raises ScanError only."""
    scan = file.read(max_points=max_points)
    try:
        found = register(scan, target, start=_start(file, scan), settings=settings, tick=tick)
    except ScanRejected as error:
        return Outcome(
            name=file.name,
            scan=None,
            reason=str(error),
            fitness=error.fitness,
            inlier_rmse=error.inlier_rmse,
        )
    return _accepted(file, found)


def chain(
    files: Sequence[ScanFile],
    *,
    settings: RegistrationSettings,
    max_points: int,
    progress: Progress = silent,
) -> tuple[tuple[Outcome, ...], Voxels]:
    """Place every scan in the frame of the first, and fuse them on the way.

    The first scan with enough structure stands at its pose prior, or at identity. A scan that finds no place is
    tried again as long as the map grows. Returns the outcomes in the order given, and the fused voxels.
    Raises ScanError, and MapFailed where no scan can hold a pose.
    """
    begun, outcomes = _first_that_holds(files, settings, max_points)
    fused = begun.voxels(settings.voxel_size)
    target = surface_of(fused, settings)
    waiting, in_vain = deque(range(len(outcomes), len(files))), 0
    while in_vain < len(waiting):  # ends when every scan that waits has met this very map
        at = waiting.popleft()
        share = 1 - (len(waiting) + 1) / len(files)

        def tick(share: float = share) -> None:
            progress("registering", share)

        outcome = place(files[at], target, settings=settings, max_points=max_points, tick=tick)
        outcomes[at] = outcome
        if outcome.scan:
            fused = fused.merged(outcome.scan.voxels(settings.voxel_size))
            target, in_vain = surface_of(fused, settings), 0
        else:
            waiting.append(at)
            in_vain += 1
    progress("registering", 1.0)
    return tuple(outcomes[at] for at in range(len(files))), fused


def _first_that_holds(
    files: Sequence[ScanFile], settings: RegistrationSettings, max_points: int
) -> tuple[RegisteredScan, dict[int, Outcome]]:
    """The scan that sets the frame, and the outcomes up to it: those before it hold no pose, anywhere."""
    outcomes: dict[int, Outcome] = {}
    for at, file in enumerate(files):
        scan = file.read(max_points=max_points)
        try:
            source_surface(scan, settings)
        except ScanRejected as error:
            outcomes[at] = Outcome(name=file.name, scan=None, reason=str(error))
            continue
        start = _start(file, scan)
        placed = as_reference(scan, np.eye(4) if start is None else start)
        outcomes[at] = Outcome(name=file.name, scan=placed)  # it fits itself: no numbers
        return placed, outcomes
    raise MapFailed("; ".join(str(outcome.reason) for outcome in outcomes.values()))


def _start(file: ScanFile, scan: Scan) -> Matrix4 | None:
    """map_from_scan as the prior has it, which speaks of the sensor; the file may know where that stood."""
    if file.pose is None:
        return None
    map_from_scan: Matrix4 = file.pose @ inverse(scan.sensor_pose)
    return map_from_scan


def _accepted(file: ScanFile, scan: RegisteredScan) -> Outcome:
    return Outcome(name=file.name, scan=scan, fitness=scan.fitness, inlier_rmse=scan.inlier_rmse)
