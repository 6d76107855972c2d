"""Corridors: straight, round a corner, and with a loop at the end. The same seed gives the same scene."""

from __future__ import annotations

import numpy as np

from worker.simulation.scenes import fittings, furniture
from worker.simulation.scenes.draft import Draft
from worker.simulation.scenes.scene import Room, Scene

Place = tuple[float, float]
Span = tuple[Place, Place]  #: a room's lowest and highest corner
#: Name, the two ends of its face, and the side of the room: see niche_wall.
Wall = tuple[str, Place, Place, int]

BLOCK = (5.0, 4.0)  #: metres, what the loop leads around
BEFORE, BEHIND = 0.7, 0.9  #: metres that stay free on either side of where two corridors meet


def corridor(
    seed: int, *, length: float = 20.0, leg: float = 18.0, width: float = 2.2, height: float = 2.6
) -> Scene:
    """Build an L of two corridors, `length` along x and `leg` along y (outer measures), door niches in every wall.

    `leg` 0 gives one straight corridor. The defaults hold about as many tiles as the paper's corridor (172).
    """
    draft = Draft(f"corridor-{seed}", np.random.default_rng(seed))
    spans: list[Span] = [((0.0, 0.0), (length, width))]
    route: list[Place] = [(0.9, width / 2), (length - width / 2, width / 2)]
    inside = length - width if leg else length
    walls = _first_walls(length, inside, width, leg or width)
    if leg:
        spans.append(((inside, width), (length, leg)))
        route.append((length - width / 2, leg - 0.9))
        walls.append(("inner", (inside, width), (inside, leg), 1))
        walls.append(("end", (inside, leg), (length, leg), -1))
        _keep_passage(draft, inside, width, width)
    rooms = _furnished(draft, spans, walls, height)
    # There and back again: a sensor that looks ahead sees both sides of everything.
    return draft.finish(rooms=rooms, route=(*route, *route[-2::-1]))


def corridor_with_loop(
    seed: int, *, length: float = 20.0, leg: float = 18.0, width: float = 2.2, height: float = 2.6
) -> Scene:
    """Build the L of `corridor`, whose second leg runs into a ring of the same width around a block of 5 x 4 m.

    The round goes down the L, once about the block, and back: 99 m, so 42 stops are 2.4 m apart.
    """
    draft = Draft(f"corridor-with-loop-{seed}", np.random.default_rng(seed))
    inside = length - width  # the corner of the L, and the block's east side
    west, south = inside - BLOCK[0], leg + width  # the block's lowest corner
    north = south + BLOCK[1]
    outer_west, top = west - width, north + width
    spans: list[Span] = [
        ((0.0, 0.0), (length, width)),
        ((inside, width), (length, leg)),
        ((outer_west, leg), (length, south)),
        ((inside, south), (length, north)),
        ((outer_west, north), (length, top)),
        ((outer_west, south), (west, north)),
    ]
    walls: list[Wall] = [
        *_first_walls(length, inside, width, top),
        ("inner", (inside, width), (inside, leg), 1),
        ("loop-south", (outer_west, leg), (inside, leg), 1),
        ("loop-west", (outer_west, leg), (outer_west, top), 1),
        ("loop-north", (outer_west, top), (length, top), -1),
        ("block-south", (west, south), (inside, south), -1),
        ("block-north", (west, north), (inside, north), 1),
        ("block-west", (west, south), (west, north), -1),
        ("block-east", (inside, south), (inside, north), 1),
    ]
    for y in (width, leg, south, north):
        _keep_passage(draft, inside, y, width)
    for y in (south, north):
        _keep_passage(draft, outer_west, y, width)
    rooms = _furnished(draft, spans, walls, height)
    half = width / 2
    way: list[Place] = [(0.9, half), (length - half, half), (length - half, leg + half)]
    about = [(outer_west + half, leg + half), (outer_west + half, top - half), (length - half, top - half)]
    return draft.finish(rooms=rooms, route=(*way, *about, *reversed(way)))


def _first_walls(length: float, inside: float, width: float, end: float) -> list[Wall]:
    """Return the walls of the corridor along x, whose east wall runs on to y = `end`."""
    return [
        ("south", (0.0, 0.0), (length, 0.0), 1),
        ("north", (0.0, width), (inside, width), -1),
        ("west", (0.0, 0.0), (0.0, width), 1),
        ("east", (length, 0.0), (length, end), -1),
    ]


def _keep_passage(draft: Draft, x: float, y: float, width: float) -> None:
    """Keep furniture away from where the corridor that begins at (x, y) meets the one before it."""
    draft.keep_clear((x, y - BEFORE), (x + width, y + BEHIND))


def _furnished(draft: Draft, spans: list[Span], walls: list[Wall], height: float) -> tuple[Room, ...]:
    """Put in floors, walls with doors, lamps, pipes, and what stands along the walls."""
    rooms = tuple(Room(low=low, high=high, height=height) for low, high in spans)
    fittings.shell(draft, rooms)
    for name, start, end, inward in walls:
        doors = fittings.openings(draft.rng, abs(end[0] - start[0]) + abs(end[1] - start[1]))
        fittings.niche_wall(draft, f"wall-{name}", start, end, inward=inward, height=height, doors=doors)
    for number, room in enumerate(rooms, start=1):
        fittings.hang_lamps(draft, room, f"lamps-{number}")
        for order, (radius, z) in enumerate(((0.06, height - 0.3), (0.04, height - 0.5)), start=1):
            pipe = fittings.pipe_along(room, radius=radius, inset=0.12, z=z)
            draft.building(f"pipe-{number}-{order}", pipe)
        line(draft, room)
    return rooms


def line(draft: Draft, room: Room, *, fixed: bool = True) -> None:
    """Put in what stands along a corridor, leaving the middle free; without what is fixed where that is there."""
    span = max(room.high[0] - room.low[0], room.high[1] - room.low[1])
    for _ in range(max(1, int(span / 7))):
        if fixed:
            draft.against_wall(room, "pillar", fittings.pillar(height=room.height - 0.7), fixed=True)
        draft.against_wall(room, "cabinet", furniture.cabinet(0.8, 0.4, float(draft.rng.uniform(0.9, 1.9))))
        draft.against_wall(room, "bench", furniture.bench())
        draft.against_wall(room, "plant", furniture.plant())
        draft.against_wall(room, "crate", furniture.crate())
        draft.against_wall(room, "bin", furniture.bin_())
        draft.against_wall(room, "extinguisher", furniture.extinguisher(), z=0.9)
        if fixed:
            draft.against_wall(room, "radiator", fittings.radiator(), z=0.12, fixed=True)
        draft.against_wall(room, "picture", fittings.picture(), z=1.4)
