"""Buildings made of parametric parts, and edits of them."""

from collections.abc import Callable, Mapping
from typing import Literal

from worker.simulation.scenes.alike import hotel_corridor, hotel_room, refurnished
from worker.simulation.scenes.buildings import random_room, small_office
from worker.simulation.scenes.corridors import corridor, corridor_with_loop
from worker.simulation.scenes.edits import changed, edit_kinds, random_edits, random_solids
from worker.simulation.scenes.mesh import Mesh, rigid
from worker.simulation.scenes.scene import Change, ChangeKind, Room, Scene, SceneObject

BuildingKind = Literal["room", "office", "corridor", "loop"]

#: What makes a building of each kind, from a seed.
BUILDINGS: Mapping[BuildingKind, Callable[[int], Scene]] = {
    "room": random_room,
    "office": small_office,
    "corridor": corridor,
    "loop": corridor_with_loop,
}

__all__ = [
    "BUILDINGS",
    "BuildingKind",
    "Change",
    "ChangeKind",
    "Mesh",
    "Room",
    "Scene",
    "SceneObject",
    "changed",
    "corridor",
    "corridor_with_loop",
    "edit_kinds",
    "hotel_corridor",
    "hotel_room",
    "random_edits",
    "random_room",
    "random_solids",
    "refurnished",
    "rigid",
    "small_office",
]
