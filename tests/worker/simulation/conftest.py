"""A bare room of known size to measure in."""

from __future__ import annotations

import numpy as np
import pytest

from worker.simulation.scenes import Room, Scene, SceneObject
from worker.simulation.scenes.mesh import block

SIZE = np.array([6.0, 4.5, 3.0])  #: metres, inside


@pytest.fixture
def bare_room() -> Scene:
    """Six slabs around 6.0 x 4.5 x 3.0 m, the inner corner in the origin; ids 1 to 6."""
    x, y, z = SIZE.tolist()
    slabs = {
        "floor": ((-0.1, -0.1, -0.1), (x + 0.1, y + 0.1, 0.0)),
        "ceiling": ((-0.1, -0.1, z), (x + 0.1, y + 0.1, z + 0.1)),
        "west": ((-0.1, 0.0, 0.0), (0.0, y, z)),
        "east": ((x, 0.0, 0.0), (x + 0.1, y, z)),
        "south": ((0.0, -0.1, 0.0), (x, 0.0, z)),
        "north": ((0.0, y, 0.0), (x, y + 0.1, z)),
    }
    objects = tuple(
        SceneObject(name=name, object_id=number, mesh=block(low, high), fixed=True)
        for number, (name, (low, high)) in enumerate(slabs.items(), start=1)
    )
    corners = ((1.5, 1.2), (4.5, 1.2), (4.5, 3.3), (1.5, 3.3), (1.5, 1.2))
    return Scene(
        name="bare", objects=objects, rooms=(Room(low=(0, 0), high=(x, y), height=z),), route=corners
    )
