"""Whole scenes: an office and single rooms. The same seed gives the same scene."""

from __future__ import annotations

import numpy as np

from worker.simulation.scenes import fittings, furniture
from worker.simulation.scenes.draft import Draft, wall
from worker.simulation.scenes.fittings import DOOR
from worker.simulation.scenes.mesh import Mesh
from worker.simulation.scenes.scene import Room, Scene

Place = tuple[float, float]

INNER = 0.12  #: metres, thickness of walls between rooms
PIECES = (6, 15)  #: of furniture in a room by itself, the last one excluded


def small_office(seed: int) -> Scene:
    """Build four furnished rooms on both sides of a corridor of 1.5 m, 10 x 8 x 2.6 m inside, doors open."""
    rng = np.random.default_rng(seed)
    draft = Draft(f"office-{seed}", rng)
    height, south, north = 2.6, 3.3, 4.8
    split_south, split_north = 5.4 + 0.6 * rng.random(), 4.2 + 0.6 * rng.random()
    half = INNER / 2
    corridor = Room(low=(0.0, south + half), high=(10.0, north - half), height=height)
    rooms = (
        Room(low=(0.0, 0.0), high=(split_south - half, south - half), height=height),
        Room(low=(split_south + half, 0.0), high=(10.0, south - half), height=height),
        Room(low=(0.0, north + half), high=(split_north - half, 8.0), height=height),
        Room(low=(split_north + half, north + half), high=(10.0, 8.0), height=height),
    )
    doors = [float(rng.uniform(room.low[0] + 0.5, room.high[0] - 1.5)) for room in rooms]
    fittings.shell(draft, (Room(low=(0.0, 0.0), high=(10.0, 8.0), height=height),))
    _outer_walls(draft, 10.0, 8.0, height)
    draft.building("wall-south", _inner_wall(south, doors[:2], height))
    draft.building("wall-north", _inner_wall(north, doors[2:], height))
    for name, x, low, high in (("a", split_south, 0.0, south - half), ("b", split_north, north + half, 8.0)):
        draft.building(f"wall-{name}", wall((x, low), (x, high), thickness=INNER, height=height))
    for number, (room, door) in enumerate(zip(rooms, doors, strict=True), start=1):
        draft.keep_clear((door - 0.1, corridor.low[1]), (door + DOOR + 0.1, corridor.high[1]))
        edge = room.high[1] - 1.0 if room.low[1] == 0.0 else room.low[1]
        draft.keep_clear((door - 0.1, edge), (door + DOOR + 0.1, edge + 1.0))
        _fit_out(draft, room, number)
    fittings.hang_lamps(draft, corridor, "lamps-corridor")
    draft.against_wall(corridor, "cabinet", furniture.cabinet(0.8, 0.35, 1.0))
    draft.against_wall(corridor, "bin", furniture.bin_())
    draft.against_wall(corridor, "plant", furniture.plant())
    return draft.finish(rooms=(*rooms, corridor), route=_round(rooms, doors, (south + north) / 2))


def random_room(seed: int, *, size: tuple[float, float, float] | None = None) -> Scene:
    """Build one room of 4-8 x 3.2-6.5 x 2.4-3.2 m, or of a given size, with 6 to 14 pieces of furniture."""
    rng = np.random.default_rng(seed)
    draft = Draft(f"room-{seed}", rng)
    drawn: tuple[float, float, float] = tuple(rng.uniform((4.0, 3.2, 2.4), (8.0, 6.5, 3.2)).tolist())
    x, y, height = size or drawn
    room = Room(low=(0.0, 0.0), high=(x, y), height=height)
    fittings.shell(draft, (room,))
    _outer_walls(draft, x, y, height, doors=fittings.openings(rng, x))
    _fit_out(draft, room, 1, pieces=int(rng.integers(*PIECES)))
    corners = [(0.3 * x, 0.3 * y), (0.7 * x, 0.3 * y), (0.7 * x, 0.7 * y), (0.3 * x, 0.7 * y)]
    return draft.finish(rooms=(room,), route=(*corners, corners[0]))


def _outer_walls(
    draft: Draft, x: float, y: float, height: float, *, doors: tuple[tuple[float, float], ...] = ()
) -> None:
    sides: list[tuple[str, Place, Place, int]] = [
        ("outer-south", (0.0, 0.0), (x, 0.0), 1),
        ("outer-north", (0.0, y), (x, y), -1),
        ("outer-west", (0.0, 0.0), (0.0, y), 1),
        ("outer-east", (x, 0.0), (x, y), -1),
    ]
    for number, (name, start, end, inward) in enumerate(sides):
        openings = doors if number == 0 else ()
        fittings.niche_wall(draft, name, start, end, inward=inward, height=height, doors=openings)


def _inner_wall(y: float, doors: list[float], height: float) -> Mesh:
    openings = tuple((door, door + DOOR) for door in doors)
    return wall((0.0, y), (10.0, y), thickness=INNER, height=height, doors=openings)


def _fit_out(draft: Draft, room: Room, number: int, *, pieces: int = 8) -> None:
    """Put in lamps, a radiator, a pillar, then furniture."""
    rng = draft.rng
    fittings.hang_lamps(draft, room, f"lamps-{number}")
    draft.against_wall(room, "radiator", fittings.radiator(), z=0.12, fixed=True)
    if rng.random() < 0.5:
        draft.against_wall(room, "pillar", fittings.pillar(height=room.height), fixed=True)
    furnish(draft, room, pieces=pieces)


def furnish(draft: Draft, room: Room, *, pieces: int = 8) -> None:
    """Put in so many pieces of furniture, half of them along the walls, and a picture."""
    rng = draft.rng
    standing = [str(kind) for kind in rng.permutation(list(furniture.WALL_PIECES))]
    free = [str(kind) for kind in rng.permutation(list(furniture.FREE_PIECES))]
    for count in range(pieces):
        if count % 2 == 0:
            kind = standing[count // 2 % len(standing)]
            draft.against_wall(room, kind, furniture.WALL_PIECES[kind]())
        else:
            kind = free[count // 2 % len(free)]
            draft.freely(room, kind, furniture.FREE_PIECES[kind]())
    draft.against_wall(room, "picture", fittings.picture(), z=1.3)


def _round(rooms: tuple[Room, ...], doors: list[float], aisle: float) -> tuple[Place, ...]:
    """Return the way along the corridor, and through every room in a loop, in the order of the doors.

    The loop turns the robot by all of 360 degrees, so that its half field of view misses no side of the room.
    """
    route: list[Place] = [(0.7, aisle)]
    for door, room in sorted(zip(doors, rooms, strict=True), key=lambda pair: pair[0]):
        x, y = door + DOOR / 2, room.high[1] if room.low[1] == 0.0 else room.low[1]
        left, right = (room.low[0] + share * (room.high[0] - room.low[0]) for share in (0.3, 0.7))
        far = y + 0.65 * (room.low[1] + room.high[1] - 2 * y)
        route += [(x, aisle), (x, y), (left, far), (right, far), (x, y), (x, aisle)]
    return (*route, (9.3, aisle))
