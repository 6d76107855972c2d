"""How well the scans were placed: what the service says of it, and how far that is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from worker.evaluation.sensor import SimulatedScan
from worker.pipeline.poses import difference
from worker.pipeline.values import Matrix4


def placement_line(visit: str, outcomes: Sequence[dict[str, Any]], scans: Sequence[SimulatedScan]) -> str:
    """One line; `outcomes` are the `scans` of a map or survey document, in the order of `scans`."""
    placed = [(outcome, scan) for outcome, scan in zip(outcomes, scans, strict=True) if outcome["accepted"]]
    line = f"{visit}: {len(placed)} of {len(scans)} scans placed"
    if not placed:
        return line
    before = _errors([(scan.prior, scan.world_from_sensor) for _, scan in placed])
    after = _errors([(np.array(out["map_from_scan"]), scan.world_from_sensor) for out, scan in placed])
    fitness = np.median([outcome["fitness"] for outcome, _ in placed])
    return f"{line}, fitness {fitness:.2f}; off by {after}, by the robot's own odometry {before}"


def _errors(pairs: list[tuple[Matrix4, Matrix4]]) -> str:
    metres, radians = np.median([difference(found, true) for found, true in pairs], axis=0)
    return f"{metres * 100:.1f} cm and {np.degrees(radians):.1f}°"
