"""How well the scans were placed: what the service says of it, and how far that is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from worker.cloud.poses import difference
from worker.cloud.types import Floats, Matrix4
from worker.simulation.sensor import SimulatedScan


def placement_line(visit: str, outcomes: Sequence[dict[str, Any]], scans: Sequence[SimulatedScan]) -> str:
    """One line; `outcomes` are the `scans` of a map or survey document, in the order of `scans`."""
    placed = [(outcome, scan) for outcome, scan in zip(outcomes, scans, strict=True) if outcome["accepted"]]
    line = f"{visit}: {len(placed)} of {len(scans)} scans placed"
    if not placed:
        return line
    before = _errors([(scan.prior, scan.world_from_sensor) for _, scan in placed])
    after = _errors([(np.array(out["map_from_scan"]), scan.world_from_sensor) for out, scan in placed])
    fitted = [outcome["fitness"] for outcome, _ in placed if outcome["fitness"] is not None]
    fitness = f", median fitness {np.median(fitted):.2f}" if fitted else ""
    return (
        f"{line}{fitness}; off by {_said(np.median(after, axis=0))}, "
        f"at worst {_said(after.max(axis=0))}; the robot's own odometry: {_said(np.median(before, axis=0))}"
    )


def _errors(pairs: list[tuple[Matrix4, Matrix4]]) -> Floats:
    """(N, 2) metres and radians between what was found and what is true."""
    return np.array([difference(found, true) for found, true in pairs])


def _said(error: Floats) -> str:
    return f"{error[0] * 100:.1f} cm and {np.degrees(error[1]):.1f}°"
