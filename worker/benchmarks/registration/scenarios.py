"""What a map is built from: the scans of one walk, with what the robot believes, and out-of-place scans among them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from worker.benchmarks.documents import names_among
from worker.benchmarks.trajectory import scan_files
from worker.cloud.types import Matrix4
from worker.pipeline.registration.results import ScanFile
from worker.progress import Progress, no_progress
from worker.simulation.scenes import BUILDINGS, Scene, corridor, random_room, small_office
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import DRIFT, drifted_within, stops, visit

ScenarioKind = Literal["drifted", "lost", "drifted+foreign", "lost+foreign"]
KINDS: tuple[ScenarioKind, ...] = get_args(ScenarioKind)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScenarioSettings:
    """What is simulated."""

    building: Literal["loop", "room"] = "loop"
    scans: int = 42
    foreign: int = 5  #: out-of-place scans, of another building
    seed: int = 1
    duration_s: float = 5.0  #: of standing at each stop; about 20,000 points a second

    def scene(self) -> Scene:
        """Build the building that is walked."""
        return BUILDINGS[self.building](self.seed)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Walk:
    """The scans that scenarios are made of, in PCD files."""

    scans: tuple[SimulatedScan, ...]
    out_of_place: tuple[SimulatedScan, ...]  #: of another building, their priors in the middle of the walk


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Scenario:
    """Files as a map is to be built from them; the sensor's frame is the file's."""

    kind: ScenarioKind
    files: tuple[ScanFile, ...]
    true: tuple[Matrix4 | None, ...]  #: world_from_sensor of each file; None for one of another building


def take_walk(settings: ScenarioSettings, folder: Path, progress: Progress = no_progress) -> Walk:
    """Simulate a visit, and a few stops in another building, into PCD files."""
    progress("simulating", 0.0)
    scans = visit(
        settings.scene(),
        settings.scans,
        seed=settings.seed,
        prior_error=DRIFT,
        drift=drifted_within,
        duration_s=settings.duration_s,
        folder=folder,
        name="stop-{:02d}",
    )
    return Walk(scans=scans, out_of_place=_out_of_place(settings, scans, folder))


def scenario(walk: Walk, kind: ScenarioKind, *, seed: int) -> Scenario:
    """Put the walk's scans together as one of the four kinds has them: with or without priors and out-of-place scans.

    Without priors the order tells nothing either: the files are shuffled.
    """
    others = walk.out_of_place if kind.endswith("foreign") else ()
    files = scan_files((*walk.scans, *others))
    true = [*(scan.world_from_sensor for scan in walk.scans), *(None for _ in others)]
    if kind.startswith("lost"):
        order = np.random.default_rng([seed, 3]).permutation(len(files)).tolist()
        files = tuple(replace(files[number], pose=None) for number in order)
        true = [true[number] for number in order]
    return Scenario(kind=kind, files=files, true=tuple(true))


def kinds_named(words: str) -> tuple[ScenarioKind, ...]:
    """Read a list with commas, in the order given; `none` is none. Raises ValueError for another name."""
    names: tuple[ScenarioKind | Literal["none"], ...] = names_among(words, (*KINDS, "none"), "scenario")
    return tuple(name for name in names if name != "none")


def _out_of_place(
    settings: ScenarioSettings, walk: tuple[SimulatedScan, ...], folder: Path
) -> tuple[SimulatedScan, ...]:
    """Take neighbouring stops in another building: a corridor of the same width, an office or a room, by the seed.

    Their priors put them in the middle of the walk, off by the same drift as the others.
    """
    seed = settings.seed + 500
    other = (random_room, corridor, small_office)[settings.seed % 3](seed)
    rng = np.random.default_rng([settings.seed, 4])
    first = 8  # of 25: neighbours that share a place, as in a folder that got mixed in
    poses = stops(other, 25, seed=seed)[first : first + settings.foreign]
    scans = visit(other, poses, seed=seed, duration_s=settings.duration_s, folder=folder, name="foreign-{}")
    out_of_place = []
    for scan in scans:
        middle = walk[len(walk) // 3 + int(rng.integers(max(1, len(walk) // 3)))].world_from_sensor
        out_of_place.append(replace(scan, prior=drifted_within(middle, DRIFT, rng)))
    return tuple(out_of_place)
