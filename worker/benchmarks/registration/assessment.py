"""How far a map's poses are from the truth, and whether the uncertainty stored with them says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worker.benchmarks.documents import Document, pose_spread
from worker.benchmarks.trajectory import WRONG, align
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.registration.results import RegistrationResult, ScanResult

Pair = tuple[float | None, float | None]  #: metres and radians


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseError:
    """One accepted scan against the truth, and the sigma that the map gives for it."""

    name: str
    metres: float
    radians: float
    from_reference: Pair  #: the same with the frame held at the map's reference scan
    sigma: Pair  #: as the map states it against that scan; None where it states none

    def document(self) -> Document:
        """Return it as JSON; centimetres and degrees."""
        return {
            "name": self.name,
            "centimetres": 100 * self.metres,
            "degrees": float(np.degrees(self.radians)),
            **_both_units("from_reference_", self.from_reference),
            **_both_units("sigma_", self.sigma),
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

    def document(self) -> Document:
        """Return it as JSON; centimetres and degrees, as the tables show them."""
        return {
            "accepted": len(self.errors),
            "of": self.scans,
            "foreign_accepted": len(self.foreign_accepted),
            "foreign": self.foreign,
            "wrong": sum(error.metres > WRONG for error in self.errors),
            **pose_spread([(error.metres, error.radians) for error in self.errors], "median", "worst"),
            "translation_sigma": _calibration([(e.from_reference[0], e.sigma[0]) for e in self.errors]),
            "rotation_sigma": _calibration([(e.from_reference[1], e.sigma[1]) for e in self.errors]),
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
    home = {scan: pose for scan, pose in enumerate(true) if pose is not None}
    out_of_place = [outcome for scan, outcome in enumerate(outcomes) if scan not in home]
    accepted = {scan: placement for scan in home if (placement := outcomes[scan].registration) is not None}
    frame: Matrix4 | None = None
    errors: list[PoseError] = []
    if accepted:
        poses = [placement.map_from_scan for placement in accepted.values()]
        frame = align(poses, [home[scan] for scan in accepted])
        held = _held_at(reference, outcomes, true)
        errors = [
            _error(outcomes[scan].name, placement, home[scan], frame, None if scan == reference else held)
            for scan, placement in accepted.items()
        ]
    return Assessment(
        scans=len(home),
        errors=tuple(errors),
        missing=tuple(outcomes[scan].name for scan in home if scan not in accepted),
        foreign=len(out_of_place),
        foreign_accepted=tuple(outcome.name for outcome in out_of_place if outcome.registration),
        true_from_map=frame,
    )


def _held_at(
    reference: int | None, outcomes: Sequence[ScanResult], true: Sequence[Matrix4 | None]
) -> Matrix4 | None:
    """Return true_from_map by the reference scan alone; None where there is none, or it is of another building."""
    if reference is None:
        return None
    placement, pose = outcomes[reference].registration, true[reference]
    if placement is None or pose is None:
        return None
    true_from_map: Matrix4 = pose @ inverse(placement.map_from_scan)
    return true_from_map


def _error(
    name: str, placement: RegistrationResult, true: Matrix4, true_from_map: Matrix4, held: Matrix4 | None
) -> PoseError:
    metres, radians = difference(true, true_from_map @ placement.map_from_scan)
    from_reference = (None, None) if held is None else difference(true, held @ placement.map_from_scan)
    sigma = placement.uncertainty
    return PoseError(
        name=name,
        metres=metres,
        radians=radians,
        from_reference=from_reference,
        sigma=(None, None) if sigma is None else (sigma.translation, sigma.rotation),
    )


def _calibration(rows: Sequence[tuple[float | None, float | None]]) -> dict[str, float] | None:
    """Compare errors with sigmas; a right sigma, of the worst direction, holds most errors within twice itself."""
    ratios = [error / sigma for error, sigma in rows if error is not None and sigma]
    if not ratios:
        return None
    return {
        "within_2_sigma": float(np.mean(np.array(ratios) <= 2)),
        "median_error_over_sigma": float(np.median(ratios)),
    }


def _both_units(prefix: str, error: Pair) -> Document:
    """Name metres and radians `<prefix>centimetres` and `<prefix>degrees`."""
    metres, radians = error
    return {
        f"{prefix}centimetres": None if metres is None else 100 * metres,
        f"{prefix}degrees": None if radians is None else float(np.degrees(radians)),
    }
