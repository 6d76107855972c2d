"""How far a map's poses are from the truth, and whether the uncertainty stored with them says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from worker.benchmarks.registration.alignment import WRONG, align
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.registration.results import RegistrationResult, ScanResult

DEGREES = 180 / np.pi  #: in a radian


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseError:
    """One accepted scan against the truth, and the sigma that the map gives for it."""

    name: str
    metres: float
    radians: float
    metres_from_reference: (
        float | None
    )  #: the same with the frame held at the map's reference scan, as sigma is
    radians_from_reference: float | None  #: None where it has none, and for that scan itself
    sigma_metres: float | None  #: None where the map states none, as for a scan that sets the frame
    sigma_radians: float | None

    def document(self) -> dict[str, Any]:
        """JSON-ready; centimetres and degrees."""
        return {
            "name": self.name,
            "centimetres": 100 * self.metres,
            "degrees": float(np.degrees(self.radians)),
            "from_reference_centimetres": _scaled(self.metres_from_reference, 100),
            "from_reference_degrees": _scaled(self.radians_from_reference, DEGREES),
            "sigma_centimetres": _scaled(self.sigma_metres, 100),
            "sigma_degrees": _scaled(self.sigma_radians, DEGREES),
        }


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Assessment:
    """A built map against the truth."""

    scans: int  #: of the building itself
    errors: tuple[PoseError, ...]  #: of those that were accepted
    missing: tuple[str, ...]  #: names of those that were not
    foreign: int  #: scans of another building
    foreign_accepted: tuple[str, ...]  #: names; each is a mistake
    true_from_map: Matrix4 | None  #: None where nothing of the building was accepted

    def document(self) -> dict[str, Any]:
        """JSON-ready; centimetres and degrees, as the tables show them."""
        metres, radians = (
            np.array([getattr(e, name) for e in self.errors]) for name in ("metres", "radians")
        )
        return {
            "accepted": len(self.errors),
            "of": self.scans,
            "foreign_accepted": len(self.foreign_accepted),
            "foreign": self.foreign,
            "wrong": int(np.sum(metres > WRONG)),
            "centimetres": _spread(100 * metres),
            "degrees": _spread(np.degrees(radians)),
            "translation_sigma": _calibration(
                [(error.metres_from_reference, error.sigma_metres) for error in self.errors]
            ),
            "rotation_sigma": _calibration(
                [(error.radians_from_reference, error.sigma_radians) for error in self.errors]
            ),
            "missing": list(self.missing),
            "scans": [error.document() for error in self.errors],
        }


def assess(
    outcomes: Sequence[ScanResult], true: Sequence[Matrix4 | None], *, reference: int | None = None
) -> Assessment:
    """Compare poses with the truth (world_from_sensor, None for a scan of another building), frames aligned.

    Scans and truth are in the same order; a scan's frame is its sensor's. `reference` is the index of the scan
    against which the map states its uncertainties.
    """
    home = {at: pose for at, pose in enumerate(true) if pose is not None}
    out_of_place = [outcome for at, outcome in enumerate(outcomes) if at not in home]
    placed = {at: found for at in home if (found := outcomes[at].registration) is not None}
    frame, held = None, _held_at(reference, outcomes, true)
    if placed:
        frame = align([found.map_from_scan for found in placed.values()], [home[at] for at in placed])
    return Assessment(
        scans=len(home),
        errors=()
        if frame is None
        else tuple(
            _error(outcomes[at].name, found, home[at], frame, None if at == reference else held)
            for at, found in placed.items()
        ),
        missing=tuple(outcomes[at].name for at in home if at not in placed),
        foreign=len(out_of_place),
        foreign_accepted=tuple(outcome.name for outcome in out_of_place if outcome.registration),
        true_from_map=frame,
    )


def _held_at(
    reference: int | None, outcomes: Sequence[ScanResult], true: Sequence[Matrix4 | None]
) -> Matrix4 | None:
    """true_from_map by the reference scan alone; None where there is none, or it is of another building."""
    if reference is None:
        return None
    placement, pose = outcomes[reference].registration, true[reference]
    if placement is None or pose is None:
        return None
    true_from_map: Matrix4 = pose @ inverse(placement.map_from_scan)
    return true_from_map


def _error(
    name: str, found: RegistrationResult, true: Matrix4, true_from_map: Matrix4, held: Matrix4 | None
) -> PoseError:
    metres, radians = difference(true, true_from_map @ found.map_from_scan)
    from_reference = (None, None) if held is None else difference(true, held @ found.map_from_scan)
    sigma = found.uncertainty
    return PoseError(
        name=name,
        metres=metres,
        radians=radians,
        metres_from_reference=from_reference[0],
        radians_from_reference=from_reference[1],
        sigma_metres=None if sigma is None else sigma.translation,
        sigma_radians=None if sigma is None else sigma.rotation,
    )


def _spread(values: np.ndarray[Any, Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    return {"median": float(np.median(values)), "worst": float(values.max())}


def _calibration(rows: Sequence[tuple[float | None, float | None]]) -> dict[str, float] | None:
    """Of (error, sigma); a sigma in the worst direction that is right holds most errors within twice its length."""
    ratios = [error / sigma for error, sigma in rows if error is not None and sigma]
    if not ratios:
        return None
    return {
        "within_2_sigma": float(np.mean(np.array(ratios) <= 2)),
        "median_error_over_sigma": float(np.median(ratios)),
    }


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value
