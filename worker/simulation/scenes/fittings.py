"""What is fixed to a building: lamps, pipes, radiators, pillars, frames. Backs towards -y, metres."""

from __future__ import annotations

import numpy as np

from worker.simulation.scenes.draft import DOOR_HEIGHT, Draft, wall
from worker.simulation.scenes.mesh import Mesh, block, box, cylinder, rigid, union
from worker.simulation.scenes.scene import Room

SLAB = 0.1  #: metres, thickness of floors and ceilings
OUTER = 0.2  #: metres, thickness of outer walls
DOOR = 0.9  #: metres, width of a door


def lamp(length: float = 1.2) -> Mesh:
    """Build a tube lamp to hang below a ceiling."""
    return box(length, 0.16, 0.07)


def radiator(width: float = 1.0) -> Mesh:
    """Build ribs on a plate."""
    ribs = [box(0.03, 0.1, 0.52).at(-width / 2 + 0.05 + step * 0.08) for step in range(int(width / 0.08) - 1)]
    return union(box(width, 0.02, 0.56), *ribs)


def pillar(width: float = 0.35, depth: float = 0.18, height: float = 2.6) -> Mesh:
    """Build a half column that reaches 3 cm back, into the gap that furniture keeps to the wall."""
    return box(width, depth, height)


def picture(width: float = 0.7, height: float = 0.5) -> Mesh:
    """Build a board in a frame."""
    return union(box(width, 0.05, height), box(width - 0.1, 0.07, height - 0.1).at(z=0.05))


def pipe_along(room: Room, *, radius: float, inset: float, z: float) -> Mesh:
    """Build a pipe along the longer side of a room, `inset` from its low side."""
    span = [high - low for low, high in zip(room.low, room.high, strict=True)]
    along_x = span[0] >= span[1]
    pipe = cylinder(radius, max(span) - 0.04, sides=16)
    x, y = room.low[0], room.low[1]
    if along_x:
        return pipe.placed(rigid(x + 0.02, y + inset, z, pitch=90))
    return pipe.placed(rigid(x + inset, y + 0.02, z, roll=-90))


def shell(draft: Draft, rooms: tuple[Room, ...]) -> None:
    """Put floor and ceiling slabs, under and over each room."""
    for number, room in enumerate(rooms, start=1):
        low = (room.low[0] - OUTER, room.low[1] - OUTER)
        high = (room.high[0] + OUTER, room.high[1] + OUTER)
        draft.building(f"floor-{number}", block((*low, -SLAB), (*high, 0.0)))
        top = room.height + SLAB
        draft.building(f"ceiling-{number}", block((*low, room.height), (*high, top)))


def niche_wall(
    draft: Draft,
    name: str,
    start: tuple[float, float],
    end: tuple[float, float],
    *,
    inward: int,
    height: float,
    doors: tuple[tuple[float, float], ...],
) -> None:
    """Build a wall along x or y whose face starts at start-end, closed doors set back in niches.

    `inward` is +1 where the room lies on the side of growing y (or x), else -1. `doors` as in `wall`.
    """
    along = 0 if start[1] == end[1] else 1
    shift = [0.0, 0.0]
    shift[1 - along] = -inward * OUTER / 2
    middle = (start[0] + shift[0], start[1] + shift[1])
    last = (end[0] + shift[0], end[1] + shift[1])
    draft.building(name, wall(middle, last, thickness=OUTER, height=height, doors=doors))
    for number, (first, stop) in enumerate(doors, start=1):
        leaf = wall((0.0, 0.0), (stop - first, 0.0), thickness=0.05, height=DOOR_HEIGHT)
        handle = block((0.06, -0.08, 1.0), (0.18, 0.08, 1.04))
        if along:
            placed = union(leaf, handle).at(middle[0] - inward * 0.05, middle[1] + first, yaw=90)
        else:
            placed = union(leaf, handle).at(middle[0] + first, middle[1] - inward * 0.05)
        draft.building(f"{name}-door-{number}", placed)


def openings(rng: np.random.Generator, length: float) -> tuple[tuple[float, float], ...]:
    """Choose the doors of a wall, about one in 4 m, none in the last metre of either end; metres, (from, to)."""
    count = int(length // 4)
    spans = [(number * length / count, (number + 1) * length / count) for number in range(count)]
    firsts = [float(rng.uniform(low + 1.0, high - 1.0 - DOOR)) for low, high in spans]
    return tuple((first, first + DOOR) for first in firsts)


def hang_lamps(draft: Draft, room: Room, name: str, *, every: float = 3.0) -> None:
    """Hang a row of lamps under the ceiling, along the longer side."""
    x, y = [(low + high) / 2 for low, high in zip(room.low, room.high, strict=True)]
    span = [high - low for low, high in zip(room.low, room.high, strict=True)]
    along = 0 if span[0] >= span[1] else 1
    count = max(1, int(span[along] / every))
    lamps = []
    for number in range(count):
        place_along = room.low[along] + (number + 0.5) * span[along] / count
        place = (place_along, y) if along == 0 else (x, place_along)
        lamps.append(lamp().at(*place, room.height - 0.08, yaw=90.0 * along))
    draft.building(name, union(*lamps))
