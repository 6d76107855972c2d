"""How far a map's poses are from the truth, and whether the uncertainty stored with them says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worker.benchmarks.documents import Document, pose_spread
from worker.benchmarks.trajectory import WRONG, align
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.registration.results import ScanResult

Pair = tuple[float | None, float | None]  #: metres and radians


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseError:
    """One accepted scan against the truth, and the sigma that the map gives for it."""

    name: str
    off: tuple[float, float]  #: metres and radians, all poses fitted to the true ones
    from_reference: Pair  #: the same with the frame held at the map's reference scan
    sigma: Pair  #: as the map states it against that scan; None where it states none

    def document(self) -> Document:
        """Return it as JSON; centimetres and degrees."""
        return {
            "name": self.name,
            **_both_units("", self.off),
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
            "wrong": sum(error.off[0] > WRONG for error in self.errors),
            **pose_spread([error.off for error in self.errors], "median", "worst"),
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
    poses = {scan: placed.map_from_scan for scan in home if (placed := outcomes[scan].registration)}
    frame = align(list(poses.values()), [home[scan] for scan in poses]) if poses else None
    held: Matrix4 | None = None  # true_from_map by the reference scan alone
    if reference is not None and reference in poses:
        held = home[reference] @ inverse(poses[reference])
    return Assessment(
        scans=len(home),
        errors=tuple(
            PoseError(
                name=outcomes[scan].name,
                off=difference(home[scan], frame @ pose),
                from_reference=_known(held if scan != reference else None, pose, home[scan]),
                sigma=_stated(outcomes[scan]),
            )
            for scan, pose in poses.items()
            if frame is not None
        ),
        missing=tuple(outcomes[scan].name for scan in home if scan not in poses),
        foreign=len(out_of_place),
        foreign_accepted=tuple(outcome.name for outcome in out_of_place if outcome.registration),
        true_from_map=frame,
    )


def _known(true_from_map: Matrix4 | None, pose: Matrix4, true: Matrix4) -> Pair:
    return (None, None) if true_from_map is None else difference(true, true_from_map @ pose)


def _stated(outcome: ScanResult) -> Pair:
    sigma = outcome.registration and outcome.registration.uncertainty
    return (sigma.translation, sigma.rotation) if sigma else (None, None)


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
