"""A room of 4 x 4 x 2.5 m, seen twice from two places, as real scans would be."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.real.visits import RealScan, TwoVisits
from worker.training.voxels.solids import Box

ROOM = (np.array([0.0, 0, 0]), np.array([4.0, 4, 2.5]))


def scan(
    name: str,
    place: tuple[float, float, float],
    *,
    boxes: tuple[Box, ...] = (),
    seed: int = 0,
    step: float = 1.0,
) -> RealScan:
    """Look around from a place, `step` degrees apart, with 5 mm of noise."""
    turns, rises = np.radians(np.arange(0, 360, step)), np.radians(np.arange(-85, 85, step))
    azimuth, elevation = (axis.ravel() for axis in np.meshgrid(turns, rises))
    flat = np.cos(elevation)
    rays = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)
    origin = np.array(place)
    with np.errstate(divide="ignore"):
        walls = np.concatenate([(corner - origin) / rays for corner in ROOM], axis=1)
    ranges = np.where(walls > 1e-9, walls, np.inf).min(axis=1)
    ranges = np.min([ranges, *(box.ranges(origin, rays) for box in boxes)], axis=0)
    ranges = ranges + np.random.default_rng(seed).normal(0, 0.005, len(ranges))
    return RealScan(
        name=name, points=(origin + rays * ranges[:, None]).astype(np.float32), sensor_origin=origin
    )


@pytest.fixture(scope="session")
def empty_room() -> TwoVisits:
    """Nothing stands in it in either visit."""
    return TwoVisits(
        name="room, 1 to 2",
        place="a room",
        first=(scan("1.pcd", (1.0, 1.0, 1.0), seed=1),),
        second=(scan("2.pcd", (3.0, 2.5, 1.0), seed=2),),
    )
