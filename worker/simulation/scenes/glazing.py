"""Glass and mirrors, put into a building that is there: what a LiDAR sees through, and what it sees twice."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from worker.simulation.scenes.mesh import Mesh, block, union
from worker.simulation.scenes.scene import Room, Scene, Surface

TRIES = 60  #: random places tried for one piece
GAP = 0.03  #: metres to the wall: door frames stand out by 2 cm
FRAME = 0.04  #: metres

#: Parts of a piece that stands with its back to a wall along x, by name: the one that shines, and its frame.
Parts = tuple[Mesh, Mesh]


def pane(rng: np.random.Generator) -> Parts:
    """Draw a glass partition that stands out from a wall by about a metre, with a frame of posts and rails."""
    out, height = float(rng.uniform(0.8, 1.2)), float(rng.uniform(1.9, 2.1))
    posts = [block((-FRAME / 2, y, 0.0), (FRAME / 2, y + FRAME, height)) for y in (0.0, out - FRAME)]
    rails = [block((-FRAME / 2, 0.0, z), (FRAME / 2, out, z + FRAME)) for z in (0.0, height - FRAME)]
    glass = block((-0.005, FRAME, FRAME), (0.005, out - FRAME, height - FRAME))
    return glass, union(*posts, *rails)


def mirror(rng: np.random.Generator) -> Parts:
    """Draw a framed mirror that hangs on a wall."""
    half, low = float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.2, 0.7))
    high = low + float(rng.uniform(1.0, 1.4))
    inner, outer = half, half + FRAME
    sides = [block((x, 0.0, low), (x + FRAME, 0.03, high)) for x in (-outer, inner)]
    rails = [block((-outer, 0.0, z), (outer, 0.03, z + FRAME)) for z in (low - FRAME, high)]
    return block((-inner, 0.0, low), (inner, 0.02, high)), union(*sides, *rails)


def glazed(scene: Scene, *, seed: int, panes: int, mirrors: int) -> Scene:
    """Put glass partitions and mirrors to the walls of a scene's rooms, as parts of the building.

    They keep clear of everything; a piece that finds no place is left out.
    """
    rng = np.random.default_rng([seed, 9])
    for number in range(panes):
        scene = _put(scene, f"pane-{number + 1}", pane, "glass", rng)
    for number in range(mirrors):
        scene = _put(scene, f"mirror-{number + 1}", mirror, "mirror", rng)
    return scene


def _put(
    scene: Scene,
    name: str,
    draw: Callable[[np.random.Generator], Parts],
    surface: Surface,
    rng: np.random.Generator,
) -> Scene:
    for _ in range(TRIES):
        room = scene.rooms[int(rng.integers(len(scene.rooms)))]
        shining, frame = draw(rng)
        x, y, yaw = _by_a_wall(room, float(np.ptp(frame.bounds[:, 0])), rng)
        frame, shining = frame.at(x, y, yaw=yaw), shining.at(x, y, yaw=yaw)
        if _fits(scene, room, frame):
            scene, _ = scene.with_added(f"{name}-frame", frame, fixed=True)
            scene, _ = scene.with_added(name, shining, fixed=True, surface=surface)
            return scene
    return scene


def _by_a_wall(room: Room, wide: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw x, y, yaw of a piece of this width with its back to a wall."""
    side = int(rng.integers(4))
    along = side % 2
    low, high = room.low[along] + GAP + wide / 2, room.high[along] - GAP - wide / 2
    offset = float(rng.uniform(low, max(low, high)))
    return (
        (offset, room.low[1] + GAP, 0.0),
        (room.high[0] - GAP, offset, 90.0),
        (offset, room.high[1] - GAP, 180.0),
        (room.low[0] + GAP, offset, 270.0),
    )[side]


def _fits(scene: Scene, room: Room, mesh: Mesh) -> bool:
    bounds = mesh.bounds
    inside = np.all(bounds[0, :2] >= room.low) and np.all(bounds[1, :2] <= room.high)
    return bool(inside) and scene.is_free(bounds)
