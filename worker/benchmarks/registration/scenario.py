"""What a map is built from: the scans of one walk, with what the robot believes, and strangers among them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from worker.cloud.formats.pcd import write_pcd
from worker.cloud.types import Matrix4
from worker.pipeline.registration.results import ScanFile
from worker.progress import Progress, no_progress
from worker.simulation.scenes import Scene, corridor, corridor_with_loop, random_room, small_office
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import drifted_within, stops, visit

Kind = Literal["drifted", "lost", "drifted+foreign", "lost+foreign"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Building = Literal["loop", "room"]

DRIFT = (0.25, 4.0)  #: metres over the floor and degrees of yaw; each prior is off by at most this


@dataclass(frozen=True, kw_only=True, slots=True)
class WalkSettings:
    """What is simulated."""

    building: Building = "loop"
    scans: int = 42
    foreign: int = 5  #: scans of another building
    seed: int = 1
    duration_s: float = 5.0  #: of standing at each stop; about 20,000 points a second


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Taken:
    """A scan in a file, and where it was taken."""

    path: Path
    prior: Matrix4  #: (4, 4) world_from_sensor as the robot believes it
    true: Matrix4 | None  #: (4, 4) world_from_sensor; None for a scan of another building


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Scenario:
    """Files as a map is to be built from them; the sensor's frame is the file's."""

    kind: Kind
    files: tuple[ScanFile, ...]
    true: tuple[Matrix4 | None, ...]  #: world_from_sensor of each file; None for one of another building


def take_walk(settings: WalkSettings, folder: Path, progress: Progress = no_progress) -> tuple[Taken, ...]:
    """Simulate a visit, and a few stops in another building, into PCD files; the strangers come last.

    The strangers' priors put them in the middle of the walk, off by the same drift as the others.
    """
    progress("simulating", 0.0)
    there = stops(scene_of(settings), settings.scans, seed=settings.seed)
    seen = visit(
        scene_of(settings),
        there,
        seed=settings.seed,
        prior_error=DRIFT,
        drift=drifted_within,
        duration_s=settings.duration_s,
    )
    taken = [
        Taken(path=_written(folder / f"stop-{number:02d}.pcd", scan), prior=scan.prior, true=pose)
        for number, (scan, pose) in enumerate(zip(seen, there, strict=True), start=1)
    ]
    return (*taken, *_strangers(settings, there, folder))


def scenario(walk: tuple[Taken, ...], kind: Kind, *, seed: int) -> Scenario:
    """The walk's scans as one of the four kinds has them: with or without priors, with or without strangers.

    Without priors the order tells nothing either: the files are shuffled.
    """
    chosen = [scan for scan in walk if kind.endswith("foreign") or scan.true is not None]
    lost = kind.startswith("lost")
    if lost:
        order = np.random.default_rng([seed, 3]).permutation(len(chosen))
        chosen = [chosen[at] for at in order]
    files = [
        ScanFile(name=scan.path.stem, path=scan.path, pose=None if lost else scan.prior) for scan in chosen
    ]
    return Scenario(kind=kind, files=tuple(files), true=tuple(scan.true for scan in chosen))


def kinds_named(words: str) -> tuple[Kind, ...]:
    """From a list with commas, in the order given; `none` is none. Raises ValueError for another name."""
    known = {str(kind): kind for kind in KINDS}
    names = [word.strip() for word in words.split(",") if word.strip() != "none"]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"no scenario {', '.join(unknown)}; there are {', '.join(KINDS)}, or none")
    return tuple(known[name] for name in names)


def scene_of(settings: WalkSettings) -> Scene:
    """The building that is walked."""
    return corridor_with_loop(settings.seed) if settings.building == "loop" else random_room(settings.seed)


def _strangers(settings: WalkSettings, there: tuple[Matrix4, ...], folder: Path) -> tuple[Taken, ...]:
    """Neighbouring stops in another building: a corridor of the same width, an office or a room, by the seed."""
    kinds = (random_room, corridor, small_office)
    other = kinds[settings.seed % 3](settings.seed + 500)
    rng = np.random.default_rng([settings.seed, 4])
    first = 8  # of 25: neighbours that share a place, as in a folder that got mixed in
    poses = stops(other, 25, seed=settings.seed + 500)[first : first + settings.foreign]
    seen = visit(other, poses, seed=settings.seed + 500, duration_s=settings.duration_s)
    out_of_place = []
    for number, scan in enumerate(seen, start=1):
        middle = there[len(there) // 3 + int(rng.integers(max(1, len(there) // 3)))]
        path = _written(folder / f"foreign-{number}.pcd", scan)
        out_of_place.append(Taken(path=path, prior=drifted_within(middle, DRIFT, rng), true=None))
    return tuple(out_of_place)


def _written(path: Path, scan: SimulatedScan) -> Path:
    write_pcd(path, scan.points)
    return path
