"""A simulated room that was scanned twice, as files with pose priors."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from worker.cloud.formats.pcd import write_pcd
from worker.simulation.scenes import Scene, corridor, random_room
from worker.simulation.scenes.furniture import crate
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import stops, visit


@dataclass(frozen=True, kw_only=True)
class Visits:
    """PCD files and the poses (4, 4) that the robot believes; the first is exact, so the map's frame is the room's."""

    first: list[tuple[Path, str]]
    second: tuple[Path, str]  #: after a crate was put there, and blind for x > `seen_to`
    seen_to: float  #: metres
    foreign: Path  #: of another building


def simulated_visits(folder: Path) -> Visits:
    """Scan a room, put a crate into it, and scan it again; write the files to `folder`."""
    room = random_room(5)
    first = visit(room, 5, seed=1, prior_error=(0.05, 1.0))
    later, _ = room.with_added("crate-new", crate(0.7, 0.5, 0.6).at(*free_place(room)))
    second = visit(later, stops(later, 1, seed=2), seed=2, prior_error=(0.05, 1.0))[0]
    seen_to = float(room.bounds.mean(axis=0)[0])
    half = second.points[second.world_points[:, 0] < seen_to]
    other = visit(corridor(3), 1, seed=3)[0]
    return Visits(
        first=[
            (_written(folder / f"first-{number}.pcd", scan.points), _pose(scan, exact=number == 0))
            for number, scan in enumerate(first)
        ],
        second=(_written(folder / "second.pcd", half), _pose(second)),
        seen_to=seen_to,
        foreign=_written(folder / "foreign.pcd", other.points),
    )


def free_place(room: Scene, *, around: tuple[float, float] | None = None) -> tuple[float, float]:
    """Return where a crate may stand (x, y): the first place, or the nearest one at least 1.2 m off a place."""
    low, high = room.rooms[0].low, room.rooms[0].high
    places = [
        (float(x), float(y))
        for x in np.linspace(low[0] + 0.6, high[0] - 0.6, 12)
        for y in np.linspace(low[1] + 0.6, high[1] - 0.6, 12)
        if room.is_free(crate(0.7, 0.5, 0.6).at(x, y).bounds)
    ]
    if around is None:
        return places[0]
    return min((math.dist(place, around), place) for place in places if math.dist(place, around) > 1.2)[1]


def _written(path: Path, points: Any) -> Path:
    write_pcd(path, points)
    return path


def _pose(scan: SimulatedScan, *, exact: bool = False) -> str:
    return json.dumps((scan.world_from_sensor if exact else scan.prior).tolist())
