"""Poses that registration finds, laid over the true ones.

A map's frame is free, so errors are counted after the best fit. That is the absolute trajectory error of Sturm et
al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), with Horn's closed form; the fit here is made
over the scans that agree with each other, so that one wrong pose shows its whole error and bends no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worker.cloud.poses import difference, fit_poses, inverse, transformed
from worker.cloud.types import Bools, Floats, Matrix4, Points
from worker.pipeline.registration.results import RegistrationResult, ScanFile, ScanResult
from worker.simulation.sensor import SimulatedScan

ARM = 1.0  #: metres along each axis of a pose; with these tips even stops on one line leave no turn free
WRONG = 0.1  #: metres; a pose that is off by this is wrong
_SPREAD = 3.0  # times the median error: what lies farther off has no say
_ROUNDS = 10


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacedScan:
    """An accepted scan with the truth about it."""

    points: Points  #: (N, 3) metres, scan frame
    placement: RegistrationResult
    true: Matrix4  #: (4, 4) map_from_scan as it would be without error

    @property
    def error(self) -> tuple[float, float]:
        """Metres and radians between the pose that was found and the true one."""
        return difference(self.placement.map_from_scan, self.true)

    @property
    def map_from_true(self) -> Matrix4:
        """What the error of the pose does to a point of the map frame."""
        moved: Matrix4 = self.placement.map_from_scan @ inverse(self.true)
        return moved


def scan_files(
    scans: Sequence[SimulatedScan], target_from_world: Matrix4 | None = None
) -> tuple[ScanFile, ...]:
    """List the files that a simulated visit wrote, with their priors in the target frame, or the world's."""
    frame = np.eye(4) if target_from_world is None else target_from_world
    return tuple(
        ScanFile(name=scan.path.stem, path=scan.path, pose=frame @ scan.prior) for scan in scans if scan.path
    )


def placed_scans(
    outcomes: Sequence[ScanResult], scans: Sequence[SimulatedScan], map_from_world: Matrix4
) -> tuple[PlacedScan, ...]:
    """List the scans that were accepted, with their true poses in the map frame."""
    return tuple(
        PlacedScan(
            points=scan.points, placement=outcome.registration, true=map_from_world @ scan.world_from_sensor
        )
        for outcome, scan in zip(outcomes, scans, strict=True)
        if outcome.registration
    )


def map_frame(outcomes: Sequence[ScanResult], scans: Sequence[SimulatedScan]) -> Matrix4:
    """Return map_from_world by the best fit of all accepted poses: a map has its priors' frame, and they drifted."""
    accepted = placed_scans(outcomes, scans, np.eye(4))
    return inverse(align([scan.placement.map_from_scan for scan in accepted], [s.true for s in accepted]))


def align(estimated: Sequence[Matrix4], true: Sequence[Matrix4]) -> Matrix4:
    """Return true_from_estimated, rigid, over the inliers of a first fit; up to half of the poses may be wrong.

    The two hold the same sensors' poses, in the same order. Raises ValueError where there are none.
    """
    if len(estimated) != len(true) or not true:
        raise ValueError(f"{len(estimated)} poses cannot be laid over {len(true)}")
    true_from_estimated = _by_one_pose(estimated, true)
    inliers: Bools | None = None
    for _ in range(_ROUNDS):
        off = distances(true_from_estimated, estimated, true)
        now = off <= max(_SPREAD * _lower_median(off), WRONG)
        if inliers is not None and np.array_equal(now, inliers):
            break
        inliers = now
        chosen = np.flatnonzero(now).tolist()
        true_from_estimated = fit_poses(
            [estimated[scan] for scan in chosen], [true[scan] for scan in chosen], arm=ARM
        )
    return true_from_estimated


def distances(true_from_estimated: Matrix4, estimated: Sequence[Matrix4], true: Sequence[Matrix4]) -> Floats:
    """Return the metres between each estimated position, once aligned, and the true one: (N,)"""
    moved = transformed(np.stack([pose[:3, 3] for pose in estimated]), true_from_estimated)
    off: Floats = np.linalg.norm(moved - np.stack([pose[:3, 3] for pose in true]), axis=1)
    return off


def _by_one_pose(estimated: Sequence[Matrix4], true: Sequence[Matrix4]) -> Matrix4:
    """Return, of the frames that single poses fix, the one in which the median of the others is least."""
    frames = [there @ inverse(here) for here, there in zip(estimated, true, strict=True)]
    return min(frames, key=lambda frame: _lower_median(distances(frame, estimated, true)))


def _lower_median(off: Floats) -> float:
    """Return of two in the middle the lower: half of the poses have to agree, no more."""
    return float(np.sort(off)[(len(off) - 1) // 2])
