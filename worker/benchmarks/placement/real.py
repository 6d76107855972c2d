"""Real scans: right pairs, all pairs of different places, and right scans that were spoilt; what each was told.

A map is built of the first file of each place, and every other file is sent to it as a survey of one scan. The true
poses were found by other registration programs, those of the Kinect's frames by our own map of all five.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.benchmarks.placement.answers import PROCESSES, TrialAnswer, answer, code_fingerprint
from worker.benchmarks.placement.sites import PlacementSite
from worker.benchmarks.placement.surveys import Survey
from worker.benchmarks.registration.real import FRAMES, PAIRS
from worker.cloud import npz
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import inverse
from worker.cloud.types import Floats, Matrix4
from worker.errors import MapFailed
from worker.pipeline.flow import build_map
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.settings import PipelineSettings
from worker.processes import open_processes
from worker.progress import Progress, no_progress
from worker.simulation.scenes import rigid

REAL = "real"  #: folder of what was said of real scans
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
class RealTrial:
    """A scan as it is sent to a map."""

    name: str
    site: Path  #: file of the map
    path: Path
    true: Matrix4 | None  #: map_from_scan; None where it has none
    prior: Matrix4 | None = None  #: map_from_scan as it is given


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Task:
    trial: RealTrial
    settings: PipelineSettings
    kept: Path


def evaluate_real(
    folder: Path,
    settings: PipelineSettings,
    out: Path,
    *,
    processes: int = PROCESSES,
    progress: Progress = no_progress,
) -> list[Document]:
    """Send every scan to every map; JSON-ready. Answers are kept under `out`, for the code that gave them.

    Raises OSError where a file is missing, MapFailed.
    """
    with TemporaryDirectory(prefix="spicd-placement-") as scratch:
        progress("real scans: maps", 0.0)
        trials = real_trials(folder, settings, Path(scratch))
        kept = out / REAL / code_fingerprint()
        tasks = [
            _Task(trial=trial, settings=settings, kept=kept / f"{_file_name(trial.name)}.json")
            for trial in trials
        ]
        missing = [task for task in tasks if not task.kept.exists()]
        with open_processes(min(processes, PROCESSES, len(missing))) as pool:
            for done, _ in enumerate(pool.map_unordered(_answer_and_keep, missing)):
                progress("real scans", done / len(missing))
        return [_row(task.trial, TrialAnswer.read(task.kept)) for task in tasks]


def real_trials(folder: Path, settings: PipelineSettings, scratch: Path) -> tuple[RealTrial, ...]:
    """List what is sent to the map of every place; maps and spoilt files are written into `scratch`."""
    places = real_places(folder, settings)
    trials: list[RealTrial] = []
    for place in places:
        site = scratch / f"{_file_name(place.name)}.npz"
        npz.save(site, real_site(place, settings))
        trials += _trials(place, places, site, scratch, settings)
    return tuple(trials)


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


def real_site(place: RealPlace, settings: PipelineSettings) -> PlacementSite:
    """Build the map of a place's first file; the world is that file's frame. Raises MapFailed."""
    built = build_map([ScanFile(name=place.first.stem, path=place.first)], settings=settings)
    (outcome,) = built.outcomes
    if outcome.registration is None:  # build_map raises where no scan holds a pose
        raise MapFailed(f"{place.first.name} makes no map")
    return PlacementSite(
        name=place.name,
        reference=built.reference,
        seen=built.seen,
        map_from_world=outcome.registration.map_from_scan,
        stops=np.eye(4)[None],
    )


def _trials(
    place: RealPlace, places: Sequence[RealPlace], site: Path, scratch: Path, settings: PipelineSettings
) -> Iterator[RealTrial]:
    """List what is sent to the map of one place: its first other file is spoilt too."""
    map_from_first = _loaded(site).map_from_world
    for number, (path, first_from_other) in enumerate(place.others.items()):
        true = map_from_first @ first_from_other
        name = f"{place.name}: {path.stem}"
        yield RealTrial(name=f"{name}, right", site=site, path=path, true=true)
        yield RealTrial(name=f"{name}, right, prior", site=site, path=path, true=true, prior=true)
        if number == 0:
            yield from _with_wrong_priors(name, site, path, true)
            yield from _spoilt(name, site, path, true, scratch, settings, shifted=place.name == SHIFTED)
    for other in places:
        if other is not place:
            for path in (other.first, *other.others):
                name = f"{place.name}: {path.stem} of {other.name}"
                yield RealTrial(name=name, site=site, path=path, true=None)


def _with_wrong_priors(name: str, site: Path, path: Path, true: Matrix4) -> Iterator[RealTrial]:
    for metres in METRES_OFF:
        off = true.copy()
        off[0, 3] += metres
        named = f"{name}, prior off by {metres:g} m"
        yield RealTrial(name=named, site=site, path=path, true=true, prior=off)
    for degrees in DEGREES_OFF:
        off = true.copy()
        off[:3, :3] = rigid(yaw=degrees)[:3, :3] @ off[:3, :3]
        named = f"{name}, prior turned by {degrees:g} degrees"
        yield RealTrial(name=named, site=site, path=path, true=true, prior=off)


def _spoilt(
    name: str,
    site: Path,
    path: Path,
    true: Matrix4,
    scratch: Path,
    settings: PipelineSettings,
    *,
    shifted: bool,
) -> Iterator[RealTrial]:
    """Mirror, scale and shift a file; one that is only shifted still has its place."""
    points = read_scan(path, name=path.name, max_points=settings.max_scan_points).points
    mirrored = _written(points * np.array([-1.0, 1.0, 1.0]), scratch / f"{path.stem}-mirrored.pcd")
    yield RealTrial(name=f"{name}, mirrored", site=site, path=mirrored, true=None)
    yield RealTrial(name=f"{name}, mirrored, prior", site=site, path=mirrored, true=None, prior=true)
    for scale in SCALES:
        scaled = _written(points * scale, scratch / f"{path.stem}-{scale:g}.pcd")
        yield RealTrial(name=f"{name}, scaled by {scale:g}", site=site, path=scaled, true=None)
    if shifted:
        far = _written(points + np.array(FAR), scratch / f"{path.stem}-shifted.pcd")
        name = f"{name}, shifted by {np.linalg.norm(FAR) / 1000:.0f} km"
        yield RealTrial(name=name, site=site, path=far, true=true @ inverse(rigid(*FAR)))


def _written(points: NDArray[Any], path: Path) -> Path:
    write_pcd(path, points.astype(np.float32))
    return path


def _answer_and_keep(task: _Task) -> None:
    """Send one scan to its map, and keep what was said."""
    sent = task.trial
    scan = read_scan(sent.path, name=sent.path.name, max_points=task.settings.max_scan_points)
    pose = None if sent.prior is None else sent.prior @ scan.sensor_pose
    file = ScanFile(name=sent.path.stem, path=sent.path, pose=pose)
    middle: Floats = np.median(scan.points, axis=0).astype(np.float64)
    survey = Survey(files=(file,), true=(sent.true,), middles=(middle,))
    answer(sent.name, survey, _loaded(sent.site), task.settings).keep(task.kept)


@lru_cache(maxsize=2)
def _loaded(site: Path) -> PlacementSite:
    return npz.load(site, PlacementSite)


def _row(trial: RealTrial, said: TrialAnswer) -> Document:
    (told,) = said.scans
    return {
        "name": trial.name,
        "verdict": told.verdict,
        "here": told.here,
        "centimetres": None if told.metres is None else 100 * told.metres,
        "degrees": told.degrees,
        "named": list(told.named),
        "detail": told.detail,
        "confidence": said.confidence,
        "seconds": said.seconds,
    }


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in ".-" else "_" for letter in name)
