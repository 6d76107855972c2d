"""E57 files of several stations, taken apart: one scan for each, with its own place of the sensor, in place of the file."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from service.catalog.files.blob_keys import safe_name
from service.catalog.records import Matrix, ScanOutcome, ScanRecord
from worker.cloud.formats.apart import StationEntry, stations_of
from worker.cloud.formats.extent import ROUND
from worker.cloud.formats.fields import FARTHEST
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.scan import Scan, read_scan
from worker.cloud.poses import translation
from worker.cloud.types import Floats, Matrix4
from worker.errors import ScanError
from worker.jobs.step import Context

log = logging.getLogger("worker.jobs")


class TakeApart(Protocol):
    """Records the scans that a file was taken apart into in its place; of a map's version or a survey."""

    def __call__(self, key: str, scan_id: str, parts: Mapping[str, Matrix | None]) -> object:
        """`key` names the version's job or the survey; `parts` has the pose of each scan, by its id."""


def take_stations_apart(
    context: Context, key: str, scans: Sequence[ScanOutcome], record: TakeApart, *, stage: str
) -> None:
    """Make scans of the stations of each E57 that holds several; `stage` is what is reported meanwhile.

    A step that runs again finds them. What cannot be taken apart stays, and is told when it is read.
    """
    for outcome in scans:
        scan = context.catalog.scans.get(outcome.scan_id)
        if outcome.accepted or scan.format != "e57":
            continue
        try:
            parts = _parts(context, scan, outcome.pose, stage=stage)
        except ScanError as error:
            log.warning("scan %s is not taken apart: %s", scan.scan_id, error)
            continue
        if parts:
            record(key, scan.scan_id, parts)


def _parts(
    context: Context, scan: ScanRecord, pose: Matrix | None, *, stage: str
) -> dict[str, Matrix | None]:
    """Keep a scan for each station of a file; return their poses by id, nothing where the file has one station."""
    limit = context.settings.max_scan_points
    with context.catalog.blobs.local(scan.key) as path:
        stations = stations_of(path)
        if len(stations) < 2 or sum(station.n for station in stations) > limit:
            return {}
        ids, offsets = [], []
        for number, station in enumerate(stations):
            context.report(stage, 0.0)
            read = read_scan(path, name=scan.filename, max_points=limit, station=number)
            ids.append(_kept(context, scan, read, number, station.name))
            offsets.append(read.offset)
    known = None if pose is None else np.array(pose, np.float64)
    return dict(zip(ids, _priors(stations, offsets, known), strict=True))


def _kept(context: Context, file: ScanRecord, read: Scan, number: int, name: str) -> str:
    """Keep the points of one station as a scan of the catalog, or find that it is one; return its id."""
    path = context.scratch / "station.pcd"
    write_pcd(path, read.points, colors=read.colors)
    ending = f"-{safe_name(name)}" if name else ""
    kept, _ = context.catalog.scans.add(
        path,
        filename=f"{Path(file.filename).stem}-{number + 1:03d}{ending}.pcd",
        format="pcd",
        size=path.stat().st_size,
        sha256=_sha256(path),
        device_id=file.device_id,
        captured_at=file.captured_at,
    )
    path.unlink(missing_ok=True)
    return kept.scan_id


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _priors(
    stations: Sequence[StationEntry], offsets: Sequence[Floats], pose: Matrix4 | None
) -> list[Matrix | None]:
    """Return map_from_sensor of each station: the pose that was given of the file's frame, and its own in that.

    In a country's grid one offset is taken off all of them. Stations that all stand at one place tell nothing: nobody
    has registered them.
    """
    own = [np.eye(4) if station.pose is None else station.pose for station in stations]
    poses = [one @ translation(offset) for one, offset in zip(own, offsets, strict=True)]
    if all(np.allclose(one, poses[0], atol=1e-3) for one in poses):
        return [None] * len(poses)
    if pose is None:
        middle = np.median([one[:3, 3] for one in poses], axis=0)
        far = float(np.abs(middle).max()) > FARTHEST
        pose = translation(-np.round(middle / ROUND) * ROUND) if far else np.eye(4)
    return [_matrix(pose @ one) for one in poses]


def _matrix(pose: Matrix4) -> Matrix:
    a, b, c, d = (tuple(float(value) for value in row) for row in pose)
    return (a, b, c, d)  # type: ignore[return-value]  # four numbers each
