"""E57 files of several stations, taken apart: one scan for each, with its own place of the sensor, in place of the file."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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


MOST_REFUSED = 10  #: stations of a file that cannot be read; with more of them it is damaged as a whole


class TakeApart(Protocol):
    """Records the scans that a file was taken apart into in its place; of a map's version or a survey."""

    def __call__(self, key: str, scan_id: str, parts: Mapping[str, Matrix | None], *, keep: bool) -> object:
        """`key` names the version's job or the survey; `parts` has the pose of each scan, by its id.

        `keep` leaves the file behind them, to tell what of it cannot be read.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class _Station:
    """One station that was read and kept."""

    scan_id: str
    entry: StationEntry
    offset: Floats  #: (3,) metres, taken off its points


def take_stations_apart(
    context: Context, key: str, scans: Sequence[ScanOutcome], record: TakeApart, *, stage: str
) -> dict[str, str]:
    """Make scans of the stations of each E57 that holds several; `stage` is what is reported meanwhile.

    Returns, by the id of its scan, why a file is not read further: each station that can be read is a scan of its own,
    and the file is left beside them for those that cannot. Where none or too many of them cannot, it is left as a whole.
    A step that runs again finds the same. What declares too much stays, and is told when it is read.
    """
    refused = {}
    for outcome in scans:
        scan = context.catalog.scans.get(outcome.scan_id)
        if outcome.accepted or scan.format != "e57":
            continue
        try:
            parts, why = _parts(context, scan, outcome.pose, stage=stage)
        except ScanError as error:
            log.warning("scan %s is not taken apart: %s", scan.scan_id, error)
            continue
        if parts:
            record(key, scan.scan_id, parts, keep=why is not None)
        if why is not None:
            log.warning("scan %s: %s", scan.scan_id, why)
            refused[scan.scan_id] = why
    return refused


def _parts(
    context: Context, scan: ScanRecord, pose: Matrix | None, *, stage: str
) -> tuple[dict[str, Matrix | None], str | None]:
    """Keep a scan for each station of a file; return their poses by id, and why the others are none.

    Nothing comes of a file that has one station, or more points than a scan may have.
    """
    limit = context.settings.max_scan_points
    read: list[_Station] = []
    refused: list[ScanError] = []
    with context.catalog.blobs.local(scan.key) as path:
        stations = stations_of(path)
        if len(stations) < 2 or sum(station.n for station in stations) > limit:
            return {}, None
        for number, entry in enumerate(stations):
            context.report(stage, 0.0)
            name = f"station {number + 1}" + (f" ({entry.name})" if entry.name else "")
            try:
                points = read_scan(path, name=name, max_points=limit, station=number)
            except ScanError as error:
                refused.append(error)
                if len(refused) > MOST_REFUSED:
                    return {}, _why(scan, refused, stations, "too many of them, so the file is damaged")
                continue
            scan_id = _kept(context, scan, points, number, entry.name)
            read.append(_Station(scan_id=scan_id, entry=entry, offset=points.offset))
    known = None if pose is None else np.array(pose, np.float64)
    poses = dict(zip((station.scan_id for station in read), _priors(read, known), strict=True))
    end = "the others are scans of their own" if read else "none is left"
    return poses, _why(scan, refused, stations, end) if refused else None


def _why(scan: ScanRecord, refused: Sequence[ScanError], stations: Sequence[StationEntry], end: str) -> str:
    """Say which stations cannot be read, and why not."""
    told = "; ".join(map(str, refused[:3])) + ("; and so on" if len(refused) > 3 else "")
    return f"{scan.filename}: {len(refused)} of {len(stations)} stations cannot be read, {end}: {told}"


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


def _priors(stations: Sequence[_Station], pose: Matrix4 | None) -> list[Matrix | None]:
    """Return map_from_sensor of each station: the pose that was given of the file's frame, and its own in that.

    In a country's grid one offset is taken off all of them. Stations that all stand at one place tell nothing: nobody
    has registered them. One that is alone tells nothing where it stands at the origin of a frame without a pose.
    """
    own = [np.eye(4) if station.entry.pose is None else station.entry.pose for station in stations]
    poses = [one @ translation(station.offset) for one, station in zip(own, stations, strict=True)]
    alone = len(poses) == 1 and (pose is not None or not np.allclose(own[0], np.eye(4)))
    if not alone and all(np.allclose(one, poses[0], atol=1e-3) for one in poses):
        return [None] * len(poses)
    if pose is None:
        middle = np.median([one[:3, 3] for one in poses], axis=0)
        far = float(np.abs(middle).max()) > FARTHEST
        pose = translation(-np.round(middle / ROUND) * ROUND) if far else np.eye(4)
    return [_matrix(pose @ one) for one in poses]


def _matrix(pose: Matrix4) -> Matrix:
    a, b, c, d = (tuple(float(value) for value in row) for row in pose)
    return (a, b, c, d)  # type: ignore[return-value]  # four numbers each
