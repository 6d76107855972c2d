"""A job's scans: uploads as local files, what became of them, and those that were accepted."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from service.catalog.records import Placement, PlacementState, ScanOutcome, ScanWarning
from worker.cloud import npz
from worker.cloud.seen import Seen
from worker.errors import ScanError
from worker.jobs.step import Context, load, put
from worker.pipeline import archive
from worker.pipeline.registration.diagnosis import Diagnosis
from worker.pipeline.registration.results import (
    RegisteredScan,
    ScanFile,
    ScanResult,
    SurveyPlacement,
    read_registered,
    with_carrier,
)
from worker.pipeline.settings import PipelineSettings


def scan_files(
    context: Context,
    scans: Sequence[ScanOutcome],
    stack: ExitStack,
    settings: PipelineSettings,
    *,
    refused: Mapping[str, str],
) -> tuple[ScanFile, ...]:
    """Return the uploads of one visit as local files for as long as the stack is open, less their carrier.

    `refused` has, by the id of a scan, why it is not read (`stations.take_stations_apart`). The pose is that of the
    scan's use in this map or survey, whatever the upload says by now.
    """
    files = []
    for outcome in scans:
        scan = context.catalog.scans.get(outcome.scan_id)
        path = stack.enter_context(context.catalog.blobs.local(scan.key))
        pose = None if outcome.pose is None else np.array(outcome.pose, np.float64)
        why = refused.get(outcome.scan_id)
        files.append(ScanFile(name=scan.filename, path=path, pose=pose, refused=why))
    return with_carrier(files, settings.carrier, max_points=settings.max_scan_points)


def scan_outcomes(scans: Sequence[ScanOutcome], outcomes: Sequence[ScanResult]) -> tuple[ScanOutcome, ...]:
    """Return what became of each scan, as it is recorded."""
    ids = [scan.scan_id for scan in scans]
    return tuple(_recorded(scan_id, outcome, ids) for scan_id, outcome in zip(ids, outcomes, strict=True))


def unread(files: Sequence[ScanFile], error: ScanError, *, max_points: int) -> tuple[ScanResult, ...]:
    """Return why each file of a visit was left out, of which none could be read; `error` is that of one of them."""
    results = []
    for file in files:
        why = error
        try:
            file.read(max_points=max_points)
        except ScanError as own:
            why = own
        results.append(ScanResult.rejected(file.name, why))
    return tuple(results)


def recorded_placement(placement: SurveyPlacement) -> Placement:
    """Return the placement of a survey of accepted scans, as it is recorded."""
    state: PlacementState = "in_doubt" if placement.in_doubt else "confirmed"
    return Placement(state=state, confidence=placement.confidence)


def kept_placement(placement: Placement | None) -> SurveyPlacement | None:
    """Return what was recorded of a survey of accepted scans; None where it was registered by an earlier release."""
    if placement is None or placement.state == "refused":
        return None
    return SurveyPlacement(confidence=placement.confidence or 0.0, in_doubt=placement.state == "in_doubt")


def save_scans(
    context: Context,
    scans: Sequence[ScanOutcome],
    files: Sequence[ScanFile],
    outcomes: Sequence[ScanResult],
    key_of: Callable[[str], str],
) -> None:
    """Keep the points of every accepted scan; one file is read at a time."""
    for done, (scan, file, result) in enumerate(zip(scans, files, outcomes, strict=True)):
        context.report("saving", done / len(scans))
        if result.registration is not None:
            points = read_registered(file, result.registration, max_points=context.settings.max_scan_points)
            put(context, key_of(scan.scan_id), functools.partial(npz.save, value=points))


def kept_scan(context: Context, key: str) -> RegisteredScan:
    """Return an accepted scan as `save_scans` kept it."""
    return load(context, key, archive.load_scan)


def kept_scans(
    context: Context, scans: Sequence[ScanOutcome], key_of: Callable[[str], str]
) -> list[Callable[[], RegisteredScan]]:
    """Return what loads each accepted scan."""
    return [functools.partial(kept_scan, context, key_of(scan.scan_id)) for scan in scans if scan.accepted]


def seen_by(
    context: Context, key: str, scans: Sequence[Callable[[], RegisteredScan]], *, voxel_size: float
) -> Seen:
    """Return what accepted scans saw; where an earlier release kept nothing of it, it is made of the scans and kept.

    Two steps that do so at once write the same. Raises FileNotFoundError where a scan is gone.
    """
    if context.catalog.blobs.exists(key):
        return load(context, key, functools.partial(npz.load, kind=Seen))
    seen = Seen.of((load_one() for load_one in scans), voxel_size=voxel_size)
    put(context, key, functools.partial(npz.save, value=seen))
    return seen


def _recorded(scan_id: str, outcome: ScanResult, ids: Sequence[str]) -> ScanOutcome:
    return ScanOutcome(
        scan_id=scan_id,
        accepted=outcome.registration is not None,
        fitness=outcome.fitness,
        rmse=outcome.inlier_rmse,
        confidence=outcome.confidence,
        **_pose(outcome, ids),
        **_why(outcome.diagnosis),
        warnings=tuple(
            ScanWarning(reason=one.reason, detail=one.detail, numbers=_finite(one.numbers))
            for one in outcome.warnings
        ),
    )


def _pose(outcome: ScanResult, ids: Sequence[str]) -> dict[str, Any]:
    """Return where an accepted scan stands and how sure that is; `ids` are those of all scans."""
    registration = outcome.registration
    if registration is None:
        return {}
    sigma = registration.uncertainty
    return {
        "map_from_scan": registration.map_from_scan.tolist(),
        "translation_sigma": None if sigma is None else sigma.translation,
        "rotation_sigma": None if sigma is None else sigma.rotation,
        "path": tuple(ids[index] for index in registration.path) or None,
    }


def _why(diagnosis: Diagnosis | None) -> dict[str, Any]:
    """Return why a scan was left out."""
    if diagnosis is None:
        return {}
    return {
        "reason": diagnosis.reason,
        "detail": diagnosis.detail,
        "numbers": _finite(diagnosis.numbers),
        "candidates": [pose.tolist() for pose in diagnosis.poses] or None,
    }


def _finite(numbers: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers as JSON has them; one that could not be measured is not there."""
    return {name: float(value) for name, value in numbers.items() if math.isfinite(value)}
