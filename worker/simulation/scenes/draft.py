"""A scene while it is being built: pieces go where they fit."""

from __future__ import annotations

import numpy as np

from worker.cloud.types import Floats
from worker.simulation.scenes.mesh import Mesh, block, union
from worker.simulation.scenes.scene import Room, Scene, SceneObject

WALL_GAP = 0.03  #: metres between a wall and what stands against it; door frames stand out by 2 cm
DOOR_HEIGHT = 2.05  #: metres
TRIES = 40  #: random places tried before a piece is left out


class Draft:
    """Collects objects, numbers them, and keeps furniture out of walls, of other pieces and of doorways."""

    def __init__(self, name: str, rng: np.random.Generator) -> None:
        self.name = name
        self.rng = rng
        self._scene = Scene(name=name, objects=())
        self._doorways: list[Floats] = []

    @classmethod
    def in_shell(cls, scene: Scene, name: str, rng: np.random.Generator) -> Draft:
        """Begin with what is fixed in a scene, and nothing else."""
        draft = cls(name, rng)
        draft._scene = Scene(name=name, objects=tuple(item for item in scene.objects if item.fixed))
        return draft

    def building(self, name: str, mesh: Mesh) -> None:
        """Add a part of the building itself."""
        self._put(name, mesh, fixed=True)

    def keep_clear(self, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Keep furniture away from here, as in front of doors; x, y, metres."""
        self._doorways.append(np.array([[*low, 0.0], [*high, 2.0]]))

    def against_wall(self, room: Room, kind: str, mesh: Mesh, *, z: float = 0.0, fixed: bool = False) -> bool:
        """Stand a piece with its back against a random wall of the room; False where it found no place."""
        low, high = mesh.bounds
        wide, deep = high[0] - low[0], WALL_GAP - low[1]
        for _ in range(TRIES):
            side = int(self.rng.integers(4))
            along = side % 2  # walls 0 and 2 run along x, 1 and 3 along y
            free = room.high[along] - room.low[along] - wide - 2 * WALL_GAP
            if free < 0:
                continue
            offset = room.low[along] + WALL_GAP + wide / 2 + free * self.rng.random()
            x, y, yaw = [
                (offset, room.low[1] + deep, 0.0),
                (room.high[0] - deep, offset, 90.0),
                (offset, room.high[1] - deep, 180.0),
                (room.low[0] + deep, offset, 270.0),
            ][side]
            if self._try(kind, mesh.at(x, y, z, yaw=yaw), fixed=fixed):
                return True
        return False

    def freely(self, room: Room, kind: str, mesh: Mesh) -> bool:
        """Stand a piece anywhere in the room, turned at random; False where it found no place."""
        for _ in range(TRIES):
            turned = mesh.at(yaw=float(self.rng.uniform(0, 360)))
            low, high = turned.bounds
            first = np.array(room.low) - low[:2] + WALL_GAP
            last = np.array(room.high) - high[:2] - WALL_GAP
            if np.all(first < last):
                x, y = self.rng.uniform(first, last)
                if self._try(kind, turned.at(x, y)):
                    return True
        return False

    def stand(
        self,
        room: Room,
        kind: str,
        mesh: Mesh,
        where: tuple[float, float, float],
        *,
        sigma: tuple[float, float],
    ) -> bool:
        """Stand a piece at x, y (metres) and yaw (degrees), off by chance; False where it fits nowhere there."""
        for _ in range(TRIES):
            (dx, dy), turn = self.rng.normal(0.0, sigma[0], 2), self.rng.normal(0.0, sigma[1])
            placed = mesh.at(where[0] + dx, where[1] + dy, yaw=where[2] + float(turn))
            low, high = placed.bounds[:, :2]
            inside = bool(np.all(low > room.low) and np.all(high < room.high))
            if inside and self._try(kind, placed):
                return True
        return False

    def finish(self, *, rooms: tuple[Room, ...], route: tuple[tuple[float, float], ...]) -> Scene:
        """Return the scene as it stands."""
        return Scene(name=self.name, objects=self._scene.objects, rooms=rooms, route=route)

    def _try(self, kind: str, mesh: Mesh, *, fixed: bool = False) -> bool:
        bounds = mesh.bounds
        if not self._scene.is_free(bounds) or any(_meet(bounds, area) for area in self._doorways):
            return False
        number = 1 + sum(item.name.rpartition("-")[0] == kind for item in self._scene.objects)
        self._put(f"{kind}-{number}", mesh, fixed=fixed)
        return True

    def _put(self, name: str, mesh: Mesh, *, fixed: bool) -> None:
        highest = max((item.object_id for item in self._scene.objects), default=0)
        item = SceneObject(name=name, object_id=1 + highest, mesh=mesh, fixed=fixed)
        self._scene = Scene(name=self.name, objects=(*self._scene.objects, item))


def _meet(a: Floats, b: Floats) -> bool:
    return bool(np.all(a[0] < b[1]) and np.all(a[1] > b[0]))


def wall(
    start: tuple[float, float],
    end: tuple[float, float],
    *,
    thickness: float,
    height: float,
    doors: tuple[tuple[float, float], ...] = (),
) -> Mesh:
    """Build a wall along x or y, its middle line from start to end, with openings.

    `doors` are (from, to) in metres along the wall. Each opening has a frame that stands out by 2 cm.
    Raises ValueError for a slanting wall.
    """
    along = 0 if start[1] == end[1] else 1
    if start[1 - along] != end[1 - along]:
        raise ValueError(f"walls run along x or y, not from {start} to {end}")

    def part(first: float, last: float, low: float, high: float, thick: float) -> Mesh:
        ends = (start[along] + first, start[along] + last)
        faces = (start[1 - along] - thick / 2, start[1 - along] + thick / 2)
        xs, ys = (ends, faces) if along == 0 else (faces, ends)
        return block((xs[0], ys[0], low), (xs[1], ys[1], high))

    parts, reached = [], 0.0
    for first, last in sorted(doors):
        parts.append(part(reached, first, 0, height, thickness))
        parts.append(part(first, last, DOOR_HEIGHT, height, thickness))
        for frame in ((first - 0.07, first + 0.01), (last - 0.01, last + 0.07)):
            parts.append(part(*frame, 0, DOOR_HEIGHT + 0.06, thickness + 0.04))
        parts.append(part(first, last, DOOR_HEIGHT - 0.01, DOOR_HEIGHT + 0.06, thickness + 0.04))
        reached = last
    parts.append(part(reached, end[along] - start[along], 0, height, thickness))
    return union(*parts)
