"""Edits that are hard to find: thin sheets before walls, things moved by a hand's breadth, chairs turned in place."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from worker.cloud.types import Floats
from worker.simulation.scenes.mesh import box
from worker.simulation.scenes.scene import Change, Room, Scene, SceneObject

TRIES = 60  #: random places or motions tried for one edit
SMALL = (0.10, 0.20)  #: metres, extents of a small thing
OFF_WALL = (0.03, 0.08)  #: metres between a wall and a sheet before it
NUDGE = (0.05, 0.15)  #: metres by which a thing is moved
TURN = (30.0, 150.0)  #: degrees by which a chair is turned, either way
CHAIRS = ("chair", "swivel-chair")

Edited = tuple[Scene, tuple[Change, ...]]
#: A random shift over the floor (metres) and turn (degrees).
Motion = Callable[[np.random.Generator], tuple[float, float, float]]


def sheets(scene: Scene, *, seed: int, count: int, name: str = "sheet") -> Edited:
    """Hang `count` boards, 1 cm thick and 40 to 90 cm wide and high, 3 to 8 cm before walls."""
    rng = np.random.default_rng([seed, 11])
    changes = []
    for number in range(1, count + 1):
        for _ in range(TRIES):
            room = scene.rooms[int(rng.integers(len(scene.rooms)))]
            wide, tall = rng.uniform(0.4, 0.9, 2).tolist()
            x, y, yaw = _before_a_wall(room, wide, float(rng.uniform(*OFF_WALL)) + 0.005, rng)
            mesh = box(wide, 0.01, tall).at(x, y, float(rng.uniform(0.5, room.height - tall - 0.5)), yaw=yaw)
            if scene.is_free(mesh.bounds):
                scene, change = scene.with_added(f"{name}-{number}", mesh)
                changes.append(change)
                break
    return scene, tuple(changes)


def nudges(scene: Scene, *, seed: int, count: int) -> Edited:
    """Move `count` pieces that stand on the floor by 5 to 15 cm."""

    def motion(rng: np.random.Generator) -> tuple[float, float, float]:
        far, way = rng.uniform(*NUDGE), rng.uniform(0, 2 * np.pi)
        return float(far * np.cos(way)), float(far * np.sin(way)), 0.0

    return _moved(scene, _standing(scene), motion, np.random.default_rng([seed, 12]), count)


def turns(scene: Scene, *, seed: int, count: int) -> Edited:
    """Turn `count` chairs about their own middle by 30 to 150 degrees; fewer where there are fewer."""

    def motion(rng: np.random.Generator) -> tuple[float, float, float]:
        return 0.0, 0.0, float(rng.uniform(*TURN) * rng.choice([-1, 1]))

    chairs = [item for item in _standing(scene) if item.name.rpartition("-")[0] in CHAIRS]
    return _moved(scene, chairs, motion, np.random.default_rng([seed, 13]), count)


def taken_away(scene: Scene, prefix: str, *, seed: int, count: int) -> Edited:
    """Take away `count` things whose names begin with a prefix; fewer where there are fewer."""
    names = [item.name for item in scene.movable if item.name.startswith(prefix)]
    changes = []
    for name in np.random.default_rng([seed, 14]).permutation(names)[:count].tolist():
        scene, change = scene.without(name)
        changes.append(change)
    return scene, tuple(changes)


def _moved(
    scene: Scene, things: Sequence[SceneObject], motion: Motion, rng: np.random.Generator, count: int
) -> Edited:
    """Move `count` of the things at random, in their room and clear of what they were clear of."""
    changes: list[Change] = []
    for number in rng.permutation(len(things)).tolist():
        name, room = things[number].name, _room_of(scene, things[number].mesh.bounds)
        for _ in range(TRIES if room is not None and len(changes) < count else 0):
            dx, dy, yaw = motion(rng)
            moved, change = scene.shifted(name, dx=dx, dy=dy, yaw=yaw)
            bounds = moved[name].mesh.bounds
            if _room_of(scene, bounds) == room and scene.is_free(bounds, ignoring=name):
                scene = moved
                changes.append(change)
                break
    return scene, tuple(changes)


def _before_a_wall(
    room: Room, wide: float, gap: float, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Draw x, y and yaw of a board of this width whose middle is `gap` metres off a wall."""
    side = int(rng.integers(4))
    along = side % 2
    low, high = room.low[along] + wide / 2, room.high[along] - wide / 2
    offset = float(rng.uniform(low, max(low, high)))
    return (
        (offset, room.low[1] + gap, 0.0),
        (room.high[0] - gap, offset, 90.0),
        (offset, room.high[1] - gap, 180.0),
        (room.low[0] + gap, offset, 270.0),
    )[side]


def _standing(scene: Scene) -> list[SceneObject]:
    return [item for item in scene.movable if float(item.mesh.bounds[0, 2]) < 0.01]


def _room_of(scene: Scene, bounds: Floats) -> Room | None:
    """Return the room that holds a box (2, 3)."""
    for room in scene.rooms:
        if np.all(bounds[0, :2] >= room.low) and np.all(bounds[1, :2] <= room.high):
            return room
    return None
