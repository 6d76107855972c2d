"""The carrier: returns from the robot, or whoever bears the sensor, that stand in every scan at the same place.

They are no part of the building. Left in, they are laid into the map at every stop of the robot, and block its view.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from worker.cloud.settings import StrictModel
from worker.cloud.types import Bools, Floats
from worker.cloud.visibility import ENOUGH, share_in_front
from worker.cloud.voxel_keys import Keys, dilated, packed, rows_of

_FEW = 3  # scans; of fewer, what repeats may be chance


class CarrierSettings(StrictModel):
    """What counts as the carrier."""

    radius: float = Field(
        0.7, ge=0, description="metres around the sensor, within which it is looked for; 0 keeps all returns"
    )
    share: float = Field(
        0.9, gt=0, le=1, description="of the scans, in which a place is hit that is the carrier's"
    )
    cell: float = Field(0.05, gt=0, description="metres, of the places that are compared")
    floor: float = Field(
        0.06,
        ge=0,
        description="metres about the floor's height that are never cut; the floor repeats as well",
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Carrier:
    """Where the carrier stands, in the sensor's own frame."""

    settings: CarrierSettings
    places: Keys | None  #: (P,) cells, ascending; None: all within the radius but the floor

    @classmethod
    def of(cls, scans: Iterable[NDArray[Any]], settings: CarrierSettings) -> Carrier:
        """Recognise what repeats near the sensor in the returns (N, 3) of each scan, metres, sensor frame.

        Of fewer than three scans, where things may repeat by chance, it is all within the radius but the floor. Scans
        with points behind points have no such frame and do not count.
        """
        if settings.radius == 0:
            return cls(settings=settings, places=np.empty(0, np.int64))
        hit = [_cells(points, settings) for points in scans if _by_one_sensor(points, settings)]
        if len(hit) < _FEW:
            return cls(settings=settings, places=None)
        cells, counts = np.unique(np.concatenate([dilated(cells, 1) for cells in hit]), return_counts=True)
        return cls(settings=settings, places=cells[counts >= settings.share * len(hit)])

    def hits(self, points: NDArray[Any]) -> Bools:
        """Tell (N,) which returns (N, 3) of one scan, metres, sensor frame, are the carrier's.

        None are where the points cannot all have been seen from the frame's origin, which then is no sensor's.
        """
        near = within(points, self.settings.radius)
        if not near.any() or not _by_one_sensor(points, self.settings):
            return np.zeros(len(points), bool)
        floor = floor_height(points, self.settings)
        if floor is not None:
            near &= np.abs(points[:, 2] - floor) > self.settings.floor
        if self.places is not None:
            rows = np.flatnonzero(near)
            near[rows] = rows_of(_packed(points[rows], self.settings.cell), self.places) >= 0
        return near


def _by_one_sensor(points: NDArray[Any], settings: CarrierSettings) -> bool:
    """Tell whether the points (N, 3) beyond the carrier's reach can all have been seen from the origin."""
    return share_in_front(points[~within(points, settings.radius)], np.zeros(3)) >= ENOUGH


def within(points: NDArray[Any], radius: float) -> Bools:
    """Tell (N,) which points (N, 3), metres, sensor frame, are within so many metres of the sensor."""
    answer: Bools = np.einsum("ij,ij->i", points, points) < radius**2
    return answer


def floor_height(points: NDArray[Any], settings: CarrierSettings) -> float | None:
    """Return the height of the floor, metres, sensor frame: the fullest level below the sensor; None without one.

    It is looked for beyond the carrier's reach and up to 3 m away, among levels of 5 cm.
    """
    flat = np.hypot(points[:, 0], points[:, 1])
    below = points[(flat > settings.radius) & (flat < 3.0) & (points[:, 2] < -0.1), 2]
    if len(below) < 50:
        return None
    levels = np.round(below / settings.cell).astype(np.int64)
    values, counts = np.unique(levels, return_counts=True)
    level = values[counts.argmax()]
    return float(np.median(below[np.abs(levels - level) <= 1]))


def _cells(points: NDArray[Any], settings: CarrierSettings) -> Keys:
    """Return the cells (N,) of the returns near to the sensor and off the floor, (N, 3)."""
    chosen = within(points, settings.radius)
    floor = floor_height(points, settings)
    if floor is not None:
        chosen &= np.abs(points[:, 2] - floor) > settings.floor
    return np.unique(_packed(points[chosen], settings.cell))


def _packed(points: NDArray[Any] | Floats, cell: float) -> Keys:
    return packed(np.floor(points / cell).astype(np.int64))
