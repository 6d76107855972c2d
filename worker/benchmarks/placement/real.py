"""Real scans: right pairs, all pairs of different places, and right scans that were spoilt; what each was told.

A map is built of the first file of each place, and every other file is sent to it as a survey of one scan. The true
poses were found by other registration programs, those of the Kinect's frames by our own map of all five.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.benchmarks.placement.answers import answer
from worker.benchmarks.placement.plan import SitePlan, Trial
from worker.benchmarks.placement.sites import PlacementSite
from worker.benchmarks.placement.surveys import Survey
from worker.benchmarks.registration.real import FRAMES, PAIRS
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import inverse
from worker.cloud.types import Matrix4
from worker.pipeline.flow import build_map
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress
from worker.simulation.scenes import rigid

SCALES = (0.95, 0.98, 1.02, 1.05)
METRES_OFF, DEGREES_OFF = (1.0, 2.0, 5.0), (90.0, 180.0)
FAR = (4000.0, -3000.0, 100.0)  #: metres that a file is shifted by
SHIFTED = "room_scan"  #: the place whose scan that is


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RealPlace:
    """The files of one place: the first is the map, the others are surveys of it."""

    name: str
    first: Path
    others: Mapping[Path, Matrix4]  #: with first_from_other


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Sent:
    """A scan as it is sent."""

    name: str
    path: Path
    true: Matrix4 | None  #: map_from_scan; None where it has none
    prior: Matrix4 | None = None  #: map_from_scan as it is given


def evaluate_real(
    folder: Path, settings: PipelineSettings, progress: Progress = no_progress
) -> list[Document]:
    """Send every scan to every map; JSON-ready. Raises OSError where a file is missing, MapFailed."""
    places = real_places(folder, settings)
    rows = []
    with TemporaryDirectory(prefix="spicd-placement-") as scratch:
        for number, place in enumerate(places):
            progress(f"real scans: {place.name}", number / len(places))
            site = _site(place, settings)
            for sent in _sent(place, places, site.map_from_world, Path(scratch), settings):
                rows.append(_told(sent, site, settings))
                progress(f"real scans: {sent.name}", number / len(places))
    return rows


def real_places(folder: Path, settings: PipelineSettings) -> tuple[RealPlace, ...]:
    """List the places with the true poses of their files. Raises OSError where a file is missing."""
    pairs = [
        RealPlace(
            name=pair.name,
            first=folder / pair.folder / pair.first,
            others={folder / pair.folder / pair.second: np.loadtxt(folder / pair.folder / pair.transform)},
        )
        for pair in PAIRS
    ]
    frames = [folder / name for name in FRAMES]
    files = [ScanFile(name=path.name, path=path) for path in frames]
    outcomes = build_map(files, settings=settings).outcomes
    results = [outcome.registration for outcome in outcomes]
    first, others = results[0], {}
    for path, result in zip(frames[1:], results[1:], strict=True):
        if first is not None and result is not None:
            others[path] = inverse(first.map_from_scan) @ result.map_from_scan
    return (*pairs, RealPlace(name="kinect", first=frames[0], others=others))


def _site(place: RealPlace, settings: PipelineSettings) -> PlacementSite:
    """Build the map of one file; the world is that file's frame."""
    built = build_map([ScanFile(name=place.first.stem, path=place.first)], settings=settings)
    (outcome,) = built.outcomes
    assert outcome.registration is not None  # build_map raises where no scan holds a pose
    map_from_first = outcome.registration.map_from_scan
    return PlacementSite(
        name=place.name,
        reference=built.reference,
        seen=built.seen,
        map_from_world=map_from_first,
        stops=np.eye(4)[None],
    )


def _sent(
    place: RealPlace,
    places: tuple[RealPlace, ...],
    map_from_first: Matrix4,
    scratch: Path,
    settings: PipelineSettings,
) -> Iterator[_Sent]:
    """List what is sent to the map of a place."""
    for path, first_from_other in place.others.items():
        true = map_from_first @ first_from_other
        name = f"{place.name}: {path.stem}"
        yield _Sent(name=f"{name}, right", path=path, true=true)
        yield _Sent(name=f"{name}, right, prior", path=path, true=true, prior=true)
        yield from _with_wrong_priors(name, path, true)
        yield from _spoilt(name, path, true, scratch, settings, shifted=place.name == SHIFTED)
    for other in places:
        if other is not place:
            for path in (other.first, *other.others):
                yield _Sent(name=f"{place.name}: {path.stem} of {other.name}", path=path, true=None)


def _with_wrong_priors(name: str, path: Path, true: Matrix4) -> Iterator[_Sent]:
    for metres in METRES_OFF:
        off = true.copy()
        off[0, 3] += metres
        yield _Sent(name=f"{name}, prior off by {metres:g} m", path=path, true=true, prior=off)
    for degrees in DEGREES_OFF:
        off = true.copy()
        off[:3, :3] = rigid(yaw=degrees)[:3, :3] @ off[:3, :3]
        yield _Sent(name=f"{name}, prior turned by {degrees:g} degrees", path=path, true=true, prior=off)


def _spoilt(
    name: str, path: Path, true: Matrix4, scratch: Path, settings: PipelineSettings, *, shifted: bool
) -> Iterator[_Sent]:
    """Mirror, scale and shift a file; one that is only shifted still has its place."""
    scan = read_scan(path, name=path.name, max_points=settings.max_scan_points)
    mirrored = _written(scan.points * np.array([-1.0, 1.0, 1.0]), scratch / "mirrored.pcd")
    yield _Sent(name=f"{name}, mirrored", path=mirrored, true=None)
    yield _Sent(name=f"{name}, mirrored, prior", path=mirrored, true=None, prior=true)
    for scale in SCALES:
        scaled = _written(scan.points * scale, scratch / "scaled.pcd")
        yield _Sent(name=f"{name}, scaled by {scale:g}", path=scaled, true=None)
    if shifted:
        far = _written(scan.points + np.array(FAR), scratch / "shifted.pcd")
        name = f"{name}, shifted by {np.linalg.norm(FAR) / 1000:.0f} km"
        yield _Sent(name=name, path=far, true=true @ inverse(rigid(*FAR)))


def _written(points: NDArray[Any], path: Path) -> Path:
    write_pcd(path, points.astype(np.float32))
    return path


def _told(sent: _Sent, site: PlacementSite, settings: PipelineSettings) -> Document:
    """Send one scan, and say what was told of it."""
    trial = Trial(site=SitePlan(kind="room", seed=0), number=0, kind="right")
    scan = read_scan(sent.path, name=sent.path.name, max_points=settings.max_scan_points)
    pose = None if sent.prior is None else sent.prior @ scan.sensor_pose
    file = ScanFile(name=sent.path.stem, path=sent.path, pose=pose)
    said = answer(trial, Survey(files=(file,), true=(sent.true,)), site, settings)
    (told,) = said.scans
    return {
        "name": sent.name,
        "verdict": told.verdict,
        "here": told.here,
        "centimetres": None if told.metres is None else 100 * told.metres,
        "degrees": told.degrees,
        "named": list(told.named),
        "detail": told.detail,
        "confidence": said.confidence,
        "seconds": said.seconds,
    }
