"""How far a map's poses are from the truth, and whether the uncertainty stored with them says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from worker.evaluation.registration.alignment import WRONG, align
from worker.pipeline.placement import Outcome, Placement
from worker.pipeline.poses import difference
from worker.pipeline.values import Matrix4


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseError:
    """One accepted scan against the truth, and the sigma that the map gives for it."""

    name: str
    metres: float
    radians: float
    sigma_metres: float | None  #: None where the map states none, as for a scan that sets the frame
    sigma_radians: float | None

    def document(self) -> dict[str, Any]:
        """JSON-ready; centimetres and degrees."""
        metres, radians = self.sigma_metres, self.sigma_radians
        return {
            "name": self.name,
            "centimetres": 100 * self.metres,
            "degrees": float(np.degrees(self.radians)),
            "sigma_centimetres": None if metres is None else 100 * metres,
            "sigma_degrees": None if radians is None else float(np.degrees(radians)),
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
        metres, radians, sigma_metres, sigma_radians = self._columns()
        return {
            "accepted": len(self.errors),
            "of": self.scans,
            "foreign_accepted": len(self.foreign_accepted),
            "foreign": self.foreign,
            "wrong": int(np.sum(metres > WRONG)),
            "centimetres": _spread(100 * metres),
            "degrees": _spread(np.degrees(radians)),
            "translation_sigma": _calibration(metres, sigma_metres),
            "rotation_sigma": _calibration(radians, sigma_radians),
            "missing": list(self.missing),
            "scans": [error.document() for error in self.errors],
        }

    def _columns(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        rows = [(e.metres, e.radians, e.sigma_metres, e.sigma_radians) for e in self.errors]
        return np.array(rows, dtype=np.float64).reshape(-1, 4).T


def assess(outcomes: Sequence[Outcome], true: Sequence[Matrix4 | None]) -> Assessment:
    """Compare poses with the truth (world_from_sensor, None for a scan of another building), frames aligned.

    Scans and truth are in the same order; a scan's frame is its sensor's.
    """
    home = [(outcome, pose) for outcome, pose in zip(outcomes, true, strict=True) if pose is not None]
    placed = [(outcome.name, outcome.placement, pose) for outcome, pose in home if outcome.placement]
    strangers = [outcome for outcome, pose in zip(outcomes, true, strict=True) if pose is None]
    frame = None
    if placed:
        frame = align([found.map_from_scan for _, found, _ in placed], [pose for _, _, pose in placed])
    return Assessment(
        scans=len(home),
        errors=() if frame is None else tuple(_error(*each, frame) for each in placed),
        missing=tuple(outcome.name for outcome, _ in home if not outcome.placement),
        foreign=len(strangers),
        foreign_accepted=tuple(outcome.name for outcome in strangers if outcome.placement),
        true_from_map=frame,
    )


def _error(name: str, found: Placement, true: Matrix4, true_from_map: Matrix4) -> PoseError:
    metres, radians = difference(true, true_from_map @ found.map_from_scan)
    return PoseError(
        name=name,
        metres=metres,
        radians=radians,
        sigma_metres=None if found.uncertainty is None else found.uncertainty.translation,
        sigma_radians=None if found.uncertainty is None else found.uncertainty.rotation,
    )


def _spread(values: np.ndarray[Any, Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    return {"median": float(np.median(values)), "worst": float(values.max())}


def _calibration(errors: np.ndarray[Any, Any], sigmas: np.ndarray[Any, Any]) -> dict[str, float] | None:
    """A sigma in the worst direction that is right holds most errors within twice its length."""
    stated = np.isfinite(sigmas) & (sigmas > 0)
    if not stated.any():
        return None
    ratio = errors[stated] / sigmas[stated]
    return {"within_2_sigma": float(np.mean(ratio <= 2)), "median_error_over_sigma": float(np.median(ratio))}
