"""Two visits as a detector by voxels gets them: what each saw, in one frame, by the true poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worker.cloud.seen import Seen
from worker.cloud.tiling import TilingSettings, grid_over, pair_tiles, touched_tiles
from worker.cloud.types import Floats, Points
from worker.detectors.comparison import Comparison, Side
from worker.simulation.sensor import SimulatedScan

VOXEL = 0.05
TILE = (1.5, 1.5, 1.0)


@dataclass(frozen=True)
class Placed:
    """A scan in the map frame."""

    points: Points
    sensor_origin: Floats | None


def seen_by(scans: Sequence[SimulatedScan], *, sights: bool = True) -> Seen:
    placed = [Placed(scan.world_points, scan.world_from_sensor[:3, 3] if sights else None) for scan in scans]
    return Seen.of(placed, voxel_size=VOXEL)


def compared(reference: Seen, current: Seen) -> Comparison:
    """Set both side by side, in all tiles that either touched."""
    both = np.concatenate([reference.points, current.points])
    grid = grid_over(both, tile_size=TILE, voxel_size=VOXEL)
    pairs = pair_tiles(
        touched_tiles(reference.points, current.points, grid),
        current.points,
        settings=TilingSettings(tiles="touched", min_points=1),
    )
    return Comparison(
        reference=Side(points=reference.points, seen=reference),
        current=Side(points=current.points, seen=current),
        tile_pairs=pairs,
    )


def swapped(comparison: Comparison) -> Comparison:
    """Take the survey for the map and the map for the survey."""
    pairs = comparison.tile_pairs
    reference = replace(pairs.reference, points=pairs.current)
    return Comparison(
        reference=comparison.current,
        current=comparison.reference,
        tile_pairs=replace(pairs, reference=reference, current=pairs.reference.points),
    )
