"""Places that look alike: the same shell with other furniture, the rooms of a hotel, and its corridors."""

from __future__ import annotations

import numpy as np

from worker.simulation.scenes import fittings, furniture
from worker.simulation.scenes.buildings import PIECES, furnish
from worker.simulation.scenes.corridors import line
from worker.simulation.scenes.draft import WALL_GAP, Draft
from worker.simulation.scenes.fittings import DOOR
from worker.simulation.scenes.mesh import Mesh, block
from worker.simulation.scenes.scene import Room, Scene

LONG = 3.0  #: times as long as wide is a corridor
PASSAGE = 0.5  #: metres around the points of a route that stay free in a building of several rooms
#: Sigma of where furniture stands in one hotel room and in the next: metres along x and y, degrees.
SHIFT, TURN = 0.1, 6.0

Piece = tuple[
    str, Mesh, float, float, float
]  #: kind, mesh, and where it stands: x, y (metres), yaw (degrees)


def refurnished(scene: Scene, seed: int) -> Scene:
    """Return the very same shell (all that is fixed) with everything else drawn anew."""
    rng = np.random.default_rng([seed, 17])
    draft = Draft.in_shell(scene, f"{scene.name}-refurnished-{seed}", rng)
    if len(scene.rooms) > 1:
        for x, y in scene.route:
            draft.keep_clear((x - PASSAGE, y - PASSAGE), (x + PASSAGE, y + PASSAGE))
    for room in scene.rooms:
        sides = np.subtract(room.high, room.low)
        if sides.max() > LONG * sides.min():
            line(draft, room, fixed=False)
        else:
            furnish(draft, room, pieces=int(rng.integers(*PIECES)))
    return draft.finish(rooms=scene.rooms, route=scene.route)


def hotel_corridor(seed: int, *, floor: int = 0) -> Scene:
    """Build a straight corridor of about 20 x 2.2 m whose doors stand opposite each other at even distances.

    The floors of a hotel, which the seed makes, have the same shell; they differ in the few things that stand there.
    """
    hotel = np.random.default_rng([seed, 18])
    length, width, height = hotel.uniform((18.0, 2.1, 2.5), (22.0, 2.3, 2.7)).tolist()
    apart = float(hotel.uniform(3.2, 4.2))
    draft = Draft(f"hotel-corridor-{seed}-{floor}", np.random.default_rng([seed, 19, floor]))
    room = Room(low=(0.0, 0.0), high=(length, width), height=height)
    fittings.shell(draft, (room,))
    firsts = np.arange(apart / 2, length - DOOR - 0.5, apart).tolist()
    doors = tuple((first, first + DOOR) for first in firsts)
    _walls(draft, room, south=doors, north=doors)
    fittings.hang_lamps(draft, room, "lamps", every=apart)
    for kind, piece in (
        ("plant", furniture.plant()),
        ("bench", furniture.bench()),
        ("bin", furniture.bin_()),
    ):
        draft.against_wall(room, kind, piece)
    draft.against_wall(room, "extinguisher", furniture.extinguisher(), z=0.9)
    for _ in range(3):
        draft.against_wall(room, "picture", fittings.picture(), z=1.4)
    ends = (0.9, width / 2), (length - 0.9, width / 2)
    return draft.finish(rooms=(room,), route=(*ends, ends[0]))


def hotel_room(seed: int, *, number: int = 0) -> Scene:
    """Build a room of a hotel, which the seed makes: every room has the same plan, the odd ones mirrored.

    The same kinds of furniture stand at the same places, but for a decimetre or two and some degrees, which `number` draws.
    """
    hotel = np.random.default_rng([seed, 20])
    width, depth, height = hotel.uniform((3.5, 5.6, 2.4), (4.4, 6.8, 2.8)).tolist()
    bath = hotel.uniform((1.5, 1.8), (1.8, 2.2)).tolist()  # what its walls take of the room, beside the door
    mirrored = number % 2 == 1

    def across(x: float) -> float:
        return width - x if mirrored else x

    draft = Draft(f"hotel-room-{seed}-{number}", np.random.default_rng([seed, 21, number]))
    room = Room(low=(0.0, 0.0), high=(width, depth), height=height)
    fittings.shell(draft, (room,))
    door = sorted((across(width - 0.35), across(width - 0.35 - DOOR)))
    _walls(draft, room, south=((door[0], door[1]),), north=())
    corner = sorted((across(0.0), across(bath[0])))
    draft.building("bath", block((corner[0], 0.0, 0.0), (corner[1], bath[1], height)))
    lamp = fittings.lamp().at(width / 2, (bath[1] + depth) / 2, height - 0.08)
    draft.building("lamp", lamp)
    draft.building("radiator", fittings.radiator().at(across(width / 2), depth - 0.08, 0.12, yaw=180))
    for kind, mesh, x, y, yaw in _hotel_furniture(width, depth, bath[1]):
        draft.stand(room, kind, mesh, (across(x), y, -yaw if mirrored else yaw), sigma=(SHIFT, TURN))
    free = (bath[0] + width) / 2, (bath[1] + depth) / 2
    ends = (across(free[0]), 0.9), (across(free[0]), free[1]), (across(width / 2), depth - 0.9)
    return draft.finish(rooms=(room,), route=(*ends, *ends[1::-1]))


def _hotel_furniture(width: float, depth: float, bath: float) -> tuple[Piece, ...]:
    """List what stands in every room: the bed with its head at the wall x = 0, the desk across from it."""
    middle, far = (bath + depth) / 2, width - WALL_GAP
    return (
        ("bed", furniture.bed(), 1.2, middle, -90.0),
        ("bedside", furniture.carton(0.4, 0.4, 0.5), 0.35, middle - 1.1, -90.0),
        ("bedside", furniture.carton(0.4, 0.4, 0.5), 0.35, middle + 1.1, -90.0),
        ("desk", furniture.desk(1.2, 0.55), far - 0.4, middle + 0.4, 90.0),
        ("swivel-chair", furniture.swivel_chair(), far - 1.0, middle + 0.4, -90.0),
        ("cabinet", furniture.cabinet(0.9, 0.5, 1.9), far - 0.4, middle - 1.0, 90.0),
        ("bin", furniture.bin_(), far - 0.3, middle + 1.35, 0.0),
    )


def _walls(
    draft: Draft,
    room: Room,
    *,
    south: tuple[tuple[float, float], ...],
    north: tuple[tuple[float, float], ...],
) -> None:
    (x, y), height = room.high, room.height
    fittings.niche_wall(draft, "wall-south", (0.0, 0.0), (x, 0.0), inward=1, height=height, doors=south)
    fittings.niche_wall(draft, "wall-north", (0.0, y), (x, y), inward=-1, height=height, doors=north)
    fittings.niche_wall(draft, "wall-west", (0.0, 0.0), (0.0, y), inward=1, height=height, doors=())
    fittings.niche_wall(draft, "wall-east", (x, 0.0), (x, y), inward=-1, height=height, doors=())
