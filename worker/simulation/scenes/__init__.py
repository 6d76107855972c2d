"""Buildings made of parametric parts, and edits of them."""

from worker.simulation.scenes.buildings import random_room, small_office
from worker.simulation.scenes.corridors import corridor, corridor_with_loop
from worker.simulation.scenes.edits import random_edits
from worker.simulation.scenes.mesh import Mesh, rigid
from worker.simulation.scenes.scene import Change, ChangeKind, Room, Scene, SceneObject

__all__ = [
    "Change",
    "ChangeKind",
    "Mesh",
    "Room",
    "Scene",
    "SceneObject",
    "corridor",
    "corridor_with_loop",
    "random_edits",
    "random_room",
    "rigid",
    "small_office",
]
