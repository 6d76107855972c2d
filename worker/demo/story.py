"""What happens in the demo: an office, and what somebody did there between two visits of a robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from worker.cloud.tiling import TileGrid
from worker.simulation.scenes import Change, Mesh, Scene, small_office
from worker.simulation.scenes.furniture import crate
from worker.simulation.sensor import SimulatedScan
from worker.simulation.truth import TileTruth, changed_tiles
from worker.simulation.visits import visit

OFFICE = 2  #: seed of the building


@dataclass(frozen=True, kw_only=True, slots=True)
class DemoSettings:
    """How long the robot works, and what judges its scans."""

    seed: int = 1
    stops: tuple[int, int] = (22, 16)  #: scans of both visits; with fewer, rooms hang together by too little
    duration_s: float = 5.0  #: seconds of standing at each
    prior_error: tuple[float, float] = (0.1, 2.0)  #: sigma of the robot's odometry, metres and degrees
    model: str | None = None  #: that the service is asked for; None: its own choice


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Edit:
    """One change and the scene on either side of it."""

    sentence: str  #: what a person would call it
    before: Scene
    after: Scene
    change: Change  #: where the thing was and is


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Story:
    """Two visits. World frame: floor z = 0, which is the map's frame too, as the first prior is exact."""

    edits: tuple[Edit, ...]
    first: tuple[SimulatedScan, ...]
    second: tuple[SimulatedScan, ...]

    def truth(self, grid: TileGrid) -> TileTruth:
        """Tell what changed in each tile (map frame) where a sensor could see it."""
        return self._between(self.edits[0].before, self.edits[-1].after, grid)

    def truth_of_each(self, grid: TileGrid) -> tuple[TileTruth, ...]:
        """Tell it for each edit alone."""
        return tuple(self._between(edit.before, edit.after, grid) for edit in self.edits)

    def _between(self, before: Scene, after: Scene, grid: TileGrid) -> TileTruth:
        return changed_tiles(
            before,
            after,
            grid,
            sensors_before=[scan.world_from_sensor for scan in self.first],
            sensors_after=[scan.world_from_sensor for scan in self.second],
        )


Step = tuple[str, Callable[[Scene], tuple[Scene, Change]]]

#: Two pieces come, two go, two are moved, each to a free place in the office of seed 2.
_STEPS: tuple[Step, ...] = (
    (
        "crate put into the west office",
        lambda s: s.with_added("crate-west", _big_crate().at(1.5, 1.0, yaw=20)),
    ),
    ("cabinet taken out of the east office", lambda s: s.without("cabinet-2")),
    ("chair moved by 1.1 m", lambda s: s.shifted("chair-2", dx=1.0, dy=0.4, yaw=-30)),
    ("plant taken away", lambda s: s.without("plant-2")),
    ("table moved by 1.2 m", lambda s: s.shifted("table-1", dx=0.8, dy=-0.9, yaw=25)),
    ("crate left in the corridor", lambda s: s.with_added("crate-hall", _big_crate().at(7.6, 4.4, yaw=4))),
)


def edits(scene: Scene) -> tuple[Edit, ...]:
    """Make every edit, one after the other."""
    done: list[Edit] = []
    for sentence, step in _STEPS:
        before = done[-1].after if done else scene
        after, change = step(before)
        done.append(Edit(sentence=sentence, before=before, after=after, change=change))
    return tuple(done)


def _big_crate() -> Mesh:
    return crate(0.7, 0.5, 0.6)


def tell(settings: DemoSettings, folder: Path | None = None) -> Story:
    """Walk the office before and after the edits; with a folder the scans are written there."""
    made = edits(small_office(OFFICE))
    scenes = {"first": made[0].before, "second": made[-1].after}
    first, second = (
        visit(
            scene,
            settings.stops[number],
            seed=10 * settings.seed + number,
            prior_error=settings.prior_error,
            duration_s=settings.duration_s,
            folder=folder,
            name=f"{name}-{{:02d}}",
        )
        for number, (name, scene) in enumerate(scenes.items())
    )
    exact = replace(first[0], prior=first[0].world_from_sensor)
    return Story(edits=made, first=(exact, *first[1:]), second=second)
