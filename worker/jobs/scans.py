"""A job's scans: uploads as local files, and what became of them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import numpy as np

from service.catalog.records import ScanOutcome
from worker.jobs.step import Context, put
from worker.pipeline import archive
from worker.pipeline.chaining import Outcome, ScanFile


def scan_files(at: Context, scans: Sequence[ScanOutcome], stack: ExitStack) -> list[ScanFile]:
    """The uploads as local files for as long as the stack is open."""
    files = []
    for each in scans:
        scan = at.catalog.scans.get(each.scan_id)
        path = stack.enter_context(at.catalog.blobs.local(scan.key))
        pose = None if scan.pose is None else np.array(scan.pose, np.float64)
        files.append(ScanFile(name=scan.filename, path=path, pose=pose))
    return files


def scan_outcomes(scans: Sequence[ScanOutcome], outcomes: Sequence[Outcome]) -> list[ScanOutcome]:
    return [
        ScanOutcome(
            scan_id=scan.scan_id,
            accepted=outcome.scan is not None,
            fitness=outcome.fitness,
            rmse=outcome.inlier_rmse,
            map_from_scan=None if outcome.scan is None else outcome.scan.map_from_scan.tolist(),
            reason=outcome.reason,
        )
        for scan, outcome in zip(scans, outcomes, strict=True)
    ]


def save_scans(
    at: Context,
    scans: Sequence[ScanOutcome],
    outcomes: Sequence[Outcome],
    key_of: Callable[[str], str],
) -> None:
    for done, (each, outcome) in enumerate(zip(scans, outcomes, strict=True)):
        at.report("saving", done / len(scans))
        scan = outcome.scan
        if scan is not None:
            put(at, key_of(each.scan_id), functools.partial(archive.save_scan, scan=scan))
