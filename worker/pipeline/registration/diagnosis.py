"""Diagnoses: why a scan was left out, or what is odd about one that was not, with the numbers that say so."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from worker.cloud.types import Matrix4

Reason = Literal[
    "unreadable",
    "damaged",
    "too_few_points",
    "degenerate",
    "too_little_overlap",
    "no_fit",
    "other_place",
    "ambiguous",
    "mirrored",
    "wrong_scale",
    "other_up_axis",
    "wrong_prior",
    "moved_while_scanning",
    "disagrees",
    "wrong_units",
    "far_from_origin",
    "far_points",
    "offset_taken_off",
    "no_sensor_place",
    "missing_returns",
    "odd_density",
    "odd_size",
    "little_coverage",
    "clock",
]
REASONS: tuple[Reason, ...] = get_args(Reason)

#: What each reason says, for documents and pictures.
MEANING: dict[Reason, str] = {
    "unreadable": "the file cannot be read",
    "damaged": "most of its points lie alone or on each other, as in a damaged file",
    "too_few_points": "too few points are left to register it",
    "degenerate": "its surfaces, or what it shares with the map, leave a motion free",
    "too_little_overlap": "the map covers too little of it",
    "no_fit": "no pose was found at which it lies on the map",
    "other_place": "it fits the map's surfaces, but rays of both visits contradict that pose: another place",
    "ambiguous": "two poses or more are supported alike",
    "mirrored": "its mirror image fits the map, it does not",
    "wrong_scale": "it fits the map after scaling",
    "other_up_axis": "it fits the map after another axis is turned up, or upside down",
    "wrong_prior": "the given prior is off by more than a prior may be",
    "moved_while_scanning": "its first and last points fit the map at different poses: the sensor moved",
    "disagrees": "the other scans of the visit would have it elsewhere, or see through it",
    "wrong_units": "its extent is that of another unit than metres",
    "far_from_origin": "its points lie kilometres from the origin of its frame, or from its sensor",
    "far_points": "a few points far from all others were left out",
    "offset_taken_off": "its coordinates lie far from their origin; an offset was taken off",
    "no_sensor_place": "nothing tells where its sensor stood",
    "missing_returns": "most of its points are missing returns",
    "odd_density": "points lie on each other, or on a grid",
    "odd_size": "it is higher than rooms are, or smaller",
    "little_coverage": "it shows few surfaces, or looks into few directions",
    "clock": "the time that was given for it cannot be right",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Diagnosis:
    """One finding about a scan: the reason that it was left out, or a warning about one that was accepted."""

    reason: Reason
    detail: str  #: one sentence with the numbers, and what to do
    numbers: Mapping[str, float] = field(
        default_factory=dict
    )  #: e.g. {"scale": 1.012}; metres, degrees, 0..1
    poses: tuple[Matrix4, ...] = ()  #: map_from_scan of the poses that nothing tells apart, where ambiguous


def length(metres: float) -> str:
    """Write a distance as people would: in kilometres from one on."""
    if metres >= 1e7:
        return "over 10,000 km"
    return f"{metres / 1000:.1f} km" if metres >= 1000 else f"{metres:.1f} m"


def without_doubles(diagnoses: Iterable[Diagnosis]) -> tuple[Diagnosis, ...]:
    """Return the first of each reason: what a map showed goes before what the scan alone makes likely."""
    first: dict[Reason, Diagnosis] = {}
    for diagnosis in diagnoses:
        first.setdefault(diagnosis.reason, diagnosis)
    return tuple(first.values())
