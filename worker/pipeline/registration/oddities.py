"""Oddities: what is odd about a scan by itself, told though it is taken; each limit lies well beyond what good scans have.

docs/reasons.md has what real and simulated scans measure.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from worker.cloud.formats.scan import Scan
from worker.cloud.types import Floats, Matrix4, Points
from worker.pipeline.registration.diagnosis import Diagnosis, Reason, length
from worker.pipeline.registration.preprocessing import PreparedScan

MOST_MISSING = 0.7  #: share of the file's points without a return
LEAST_DISTINCT = 0.45  #: share of the points that differ from each other; real scans have half and more
LEAST_GRID = 0.02  #: metres; on a grid as wide as this, or wider, points are cells of a voxel filter
HIGHEST, SMALLEST = 40.0, 1.0  #: metres: a room is lower than this, and some side of it is longer than that
LEAST_AREA = 4.0  #: square metres of surfaces
LEAST_TURN, LEAST_ELEVATIONS = 45.0, 4  #: degrees about the vertical; steps of two degrees of height
FARTHEST_SENSOR = 250.0  #: metres between the sensor and the middle of the points
STOREY = (2.1, 4.5)  #: metres from floor to ceiling
TALLER = 1.8  #: times the height along another axis, that a scan reaches along z where that axis may be up
LEAST_LEVEL = 0.02  #: share of the surfaces that lie level, or stand upright
_SAMPLE = 50_000  # points looked at, evenly over the file
_AT_ONCE = 1_000_000  # points hashed together
_PRIMES = np.array([73_856_093, 19_349_663, 83_492_791], np.uint64)  # Teschner et al., VMV 2003
_MIX = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Knuth)
_STRAYS = (1, 99)  # percentiles
_FLATTER = 1.25  # times the share of level surfaces, that face an axis which may be up
_LEVEL = (np.cos(np.radians(12.0)), np.sin(np.radians(12.0)))  # of normals against the vertical
_STEP = np.radians(2.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Figures:
    """What is measured of a scan; lengths in metres, shares in 0..1."""

    missing: float  #: share of the file's points that are no return
    distinct: float  #: share of the points that differ from each other
    grid: float  #: width of the grid that the points stand on; 0 where they stand on none
    size: Floats  #: (3,) extent along x, y, z, the prior's rotation applied; less strays
    area: float  #: square metres of surfaces, by voxels
    turn: (
        float | None
    )  #: degrees about the vertical in which something was seen; None: the sensor's place is not known
    elevations: int | None  #: steps of two degrees of height in which something was seen; likewise
    sensor: float  #: from the sensor to the middle of the points
    facing: Floats  #: (3,) share of the surfaces whose normal lies along x, y, z
    upright: float  #: share of the surfaces that stand upright

    @classmethod
    def of(
        cls, scan: Scan, prepared: PreparedScan, *, prior: Matrix4 | None = None, voxel_size: float = 0.05
    ) -> Figures:
        """Measure a scan that was prepared at `voxel_size`, metres; a prior (4, 4), map_from_scan, says what is up."""
        turn = np.eye(3) if prior is None else prior[:3, :3]
        points = prepared.surface.points @ turn.T  # (M, 3), one a voxel
        normals = np.abs(prepared.surface.normals @ turn.T)
        low, high = np.percentile(points, _STRAYS, axis=0)
        sample = scan.points[:: max(1, len(scan.points) // _SAMPLE)]
        around = None if prepared.origin is None else points - turn @ prepared.origin
        declared = len(scan.points) + scan.n_dropped + scan.n_far
        sensor = np.median(scan.points, axis=0) - scan.sensor_pose[:3, 3]
        return cls(
            missing=scan.n_dropped / max(declared, 1),
            distinct=_distinct(scan.points),
            grid=_grid(sample),
            size=high - low,
            area=len(points) * voxel_size**2,
            turn=None if around is None else _turn(around),
            elevations=None if around is None else _elevations(around),
            sensor=float(np.linalg.norm(sensor)),
            facing=(normals > _LEVEL[0]).mean(axis=0),
            upright=float((normals[:, 2] < _LEVEL[1]).mean()),
        )


def oddities(
    scan: Scan, prepared: PreparedScan, *, prior: Matrix4 | None = None, voxel_size: float = 0.05
) -> tuple[Diagnosis, ...]:
    """Return what is odd about a scan that was prepared at `voxel_size`, metres; empty of a good one."""
    figures = Figures.of(scan, prepared, prior=prior, voxel_size=voxel_size)
    checks = (_left_out, _place, _density, _size, _coverage, _up_axis)
    return tuple(
        Diagnosis(reason=reason, detail=f"scan {scan.name}: {detail}", numbers=numbers)
        for check in checks
        for reason, detail, numbers in check(scan, figures)
    )


Found = Iterator[tuple[Reason, str, dict[str, float]]]


def _left_out(scan: Scan, figures: Figures) -> Found:
    if scan.n_far:
        yield (
            "far_points",
            f"{scan.n_far} points far from all others were left out, the farthest {length(scan.farthest)} away; filter "
            "reflections, and write missing returns as NaN",
            {"points": float(scan.n_far), "farthest": scan.farthest},
        )
    if figures.missing > MOST_MISSING:
        yield (
            "missing_returns",
            f"{figures.missing:.0%} of its points ({scan.n_dropped}) are missing returns (NaN or inf); check that nothing "
            "covers the sensor",
            {"points": float(scan.n_dropped), "share": figures.missing},
        )


def _place(scan: Scan, figures: Figures) -> Found:
    if scan.offset.any():
        offset = ", ".join(f"{value:.0f}" for value in scan.offset)
        yield (
            "offset_taken_off",
            f"its coordinates lie far from their origin, as those of a country's grid do; ({offset}) m was taken off them",
            dict(zip(("x", "y", "z"), map(float, scan.offset), strict=True)),
        )
    if figures.turn is None and (scan.offset.any() or not scan.tells_sensor):
        yield (
            "no_sensor_place",
            "nothing tells where its sensor stood, so what it saw through is not known; send one scan for each place of "
            "the sensor, in the sensor's frame",
            {},
        )


def _density(scan: Scan, figures: Figures) -> Found:  # noqa: ARG001
    if figures.distinct < LEAST_DISTINCT:
        yield (
            "odd_density",
            f"only {figures.distinct:.0%} of its points are distinct; send each point once",
            {"distinct": figures.distinct},
        )
    if figures.grid >= LEAST_GRID:
        yield (
            "odd_density",
            f"its points stand on a grid of {figures.grid * 100:.1f} cm, as after a voxel filter; send the scan as the "
            "sensor gave it",
            {"grid": figures.grid},
        )


def _size(scan: Scan, figures: Figures) -> Found:  # noqa: ARG001
    across, high = float(figures.size.max()), float(figures.size[2])
    if high > HIGHEST:
        yield (
            "odd_size",
            f"it is {high:.0f} m high, over {HIGHEST:g} m; check that it is in metres, and that z is up",
            {"height": high},
        )
    elif across < SMALLEST:
        yield (
            "odd_size",
            f"it is {across:.2f} m long in all, less than {SMALLEST:g} m; check that it is in metres",
            {"length": across},
        )


def _coverage(scan: Scan, figures: Figures) -> Found:  # noqa: ARG001
    if figures.sensor > FARTHEST_SENSOR:
        yield (
            "far_from_origin",
            f"its points lie {length(figures.sensor)} from where its file says that the sensor stood, so what it saw "
            "through is not known; subtract the offset, or give the sensor's place (VIEWPOINT)",
            {"metres": figures.sensor},
        )
    if figures.area < LEAST_AREA:
        yield (
            "little_coverage",
            f"it shows {figures.area:.1f} square metres of surfaces; scan for longer, or in more directions",
            {"area": figures.area},
        )
    elif figures.turn is not None and figures.turn < LEAST_TURN:
        yield (
            "little_coverage",
            f"it looks into {figures.turn:.0f} degrees about the vertical; scan in more directions",
            {"degrees": figures.turn},
        )
    elif figures.elevations is not None and figures.elevations < LEAST_ELEVATIONS:
        yield (
            "little_coverage",
            f"it has points at {figures.elevations} heights alone (in steps of two degrees), as of one ring of a sensor; "
            "send all rings",
            {"elevations": float(figures.elevations)},
        )


def _up_axis(scan: Scan, figures: Figures) -> Found:  # noqa: ARG001
    """Tell where another axis looks like the vertical, or none; upside down cannot be told by the scan alone."""
    if figures.facing[2] < LEAST_LEVEL and figures.upright < 0.5:
        yield (
            "other_up_axis",
            f"{figures.facing[2]:.0%} of its surfaces lie level and {figures.upright:.0%} stand upright, as of a tilted "
            "sensor; turn it so that z points up, or give a pose",
            {"level": float(figures.facing[2]), "upright": figures.upright},
        )
        return
    for axis in (0, 1):
        high = float(figures.size[axis])
        flat = figures.facing[axis] > _FLATTER * figures.facing[2]
        if flat and STOREY[0] <= high <= STOREY[1] and figures.size[2] >= TALLER * high:
            yield (
                "other_up_axis",
                f"it is {figures.size[2]:.1f} m high along z and {high:.1f} m along {'xy'[axis]}, where most surfaces "
                f"face, as if {'xy'[axis]} pointed up; turn it so that z does, or give a pose",
                {"up": float(axis + 1), "height": float(figures.size[2])},
            )
            return


def _distinct(points: Points) -> float:
    """Return the share of points (N, 3) that differ from each other, of those that a hash of their place chooses."""
    step = max(1, len(points) // _SAMPLE)
    chosen = []
    for start in range(0, len(points), _AT_ONCE):
        piece = np.ascontiguousarray(points[start : start + _AT_ONCE], np.float32)
        mixed = (piece.view(np.uint32) * _PRIMES).sum(axis=1, dtype=np.uint64) * _MIX
        chosen.append(piece[(mixed >> np.uint64(40)) % step == 0])
    sample = np.concatenate(chosen)
    return len(np.unique(sample, axis=0)) / len(sample) if len(sample) else 1.0


def _grid(points: Points) -> float:
    """Return the width of the grid that the points (N, 3) stand on, the same along all axes; 0 where there is none."""
    steps = []
    for along in points.T:
        values = np.unique(np.round(along.astype(np.float64), 4))
        gaps = np.diff(values)
        gaps = gaps[gaps > 5e-4]
        if len(gaps) < 8 or len(values) > len(along) / 4:
            return 0.0
        step = float(np.percentile(gaps, 10))
        if np.mean(np.abs(gaps / step - np.round(gaps / step)) < 0.05) < 0.95:
            return 0.0
        steps.append(step)
    return min(steps) if max(steps) < 1.1 * min(steps) else 0.0


def _turn(around: Floats) -> float:
    """Return into how many degrees about the vertical points (N, 3), from the sensor, were seen."""
    angles = np.floor(np.arctan2(around[:, 1], around[:, 0]) / _STEP).astype(int)
    return float(len(np.unique(angles)) * np.degrees(_STEP))


def _elevations(around: Floats) -> int:
    """Return in how many steps of two degrees of height at least a few points (N, 3), from the sensor, were seen."""
    flat = np.hypot(around[:, 0], around[:, 1])
    steps = np.floor(np.arctan2(around[:, 2], flat) / _STEP).astype(int)
    _, counts = np.unique(steps, return_counts=True)
    return int(np.count_nonzero(counts > 0.002 * len(around)))
