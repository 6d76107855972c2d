"""A scene: named solids in one world frame, and what was edited between two visits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from worker.cloud.types import Floats, Matrix4
from worker.simulation.scenes.caster import Caster
from worker.simulation.scenes.mesh import Mesh, rigid

ChangeKind = Literal["add", "remove", "move"]
#: `matt` sends a pulse back, `glass` lets most of them through, a `mirror` turns them to what it shows
Surface = Literal["matt", "glass", "mirror"]

TOUCHING = 0.005  #: metres; boxes that meet by less than this stand beside each other


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SceneObject:
    """One named solid; walls, floors and ceilings are objects too."""

    name: str
    object_id: int  #: unique in its scene, kept through edits, never used again
    mesh: Mesh  #: world frame
    fixed: bool = False  #: part of the building: never edited by chance
    surface: Surface = "matt"


@dataclass(frozen=True, kw_only=True, slots=True)
class Room:
    """A rectangle of floor that furniture and robots may stand on, world frame, metres."""

    low: tuple[float, float]  #: x, y
    high: tuple[float, float]  #: x, y
    height: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Change:
    """One edit of a scene; boxes are (2, 3) lowest and highest corner, world frame, metres."""

    kind: ChangeKind
    name: str
    before: Floats | None  #: where it stood; None if added
    after: Floats | None  #: where it stands; None if removed


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A building that rays can be cast into. z points up, the floor is z = 0."""

    name: str
    objects: tuple[SceneObject, ...]
    rooms: tuple[Room, ...] = ()
    route: tuple[tuple[float, float], ...] = ()  #: waypoints (x, y) of a robot's round
    used_id: int = 0  #: highest object id that an edit has taken away again

    def __getitem__(self, name: str) -> SceneObject:
        """Return the object of a name. Raises KeyError with the names that there are."""
        for item in self.objects:
            if item.name == name:
                return item
        raise KeyError(f"scene {self.name} has no {name!r}; it has {', '.join(o.name for o in self.objects)}")

    @property
    def movable(self) -> tuple[SceneObject, ...]:
        """Everything that is not part of the building."""
        return tuple(item for item in self.objects if not item.fixed)

    @cached_property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest corner of the whole scene."""
        boxes = np.stack([item.mesh.bounds for item in self.objects])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    @cached_property
    def caster(self) -> Caster:
        """Built once: it costs more than a scan, and every scan uses it again."""
        return _caster_of(self.objects)

    @cached_property
    def opaque(self) -> Caster:
        """Of all but glass; the same as `caster` where there is none."""
        if self.glass is None:
            return self.caster
        return _caster_of([item for item in self.objects if item.surface != "glass"])

    @cached_property
    def glass(self) -> Caster | None:
        """Of the panes alone; None where there is none."""
        panes = [item for item in self.objects if item.surface == "glass"]
        return _caster_of(panes) if panes else None

    @cached_property
    def mirror_ids(self) -> tuple[int, ...]:
        """The object ids of the mirrors."""
        return tuple(item.object_id for item in self.objects if item.surface == "mirror")

    def placed(self, target_from_world: Matrix4) -> Scene:
        """Return the same solids in another frame; rooms and route, which know no turn, are left out."""
        objects = tuple(replace(item, mesh=item.mesh.placed(target_from_world)) for item in self.objects)
        return replace(self, objects=objects, rooms=(), route=())

    def is_free(self, bounds: Floats, *, ignoring: str | None = None) -> bool:
        """Tell whether no object's box overlaps this box (2, 3); touching is allowed."""
        for item in self.objects:
            low, high = item.mesh.bounds
            if item.name != ignoring and _overlap(bounds, low, high):
                return False
        return True

    def with_added(
        self, name: str, mesh: Mesh, *, fixed: bool = False, surface: Surface = "matt"
    ) -> tuple[Scene, Change]:
        """Return a new scene with one solid more. Raises ValueError where the name is taken."""
        if any(item.name == name for item in self.objects):
            raise ValueError(f"scene {self.name} already has {name!r}")
        added = SceneObject(
            name=name, object_id=1 + self._highest_id, mesh=mesh, fixed=fixed, surface=surface
        )
        scene = replace(self, objects=(*self.objects, added))
        return scene, Change(kind="add", name=name, before=None, after=mesh.bounds)

    def without(self, name: str) -> tuple[Scene, Change]:
        """Return a new scene with one solid less. Raises KeyError for an unknown name."""
        gone = self[name]
        rest = tuple(item for item in self.objects if item is not gone)
        scene = replace(self, objects=rest, used_id=self._highest_id)
        return scene, Change(kind="remove", name=name, before=gone.mesh.bounds, after=None)

    def moved(self, name: str, target_from_source: Matrix4) -> tuple[Scene, Change]:
        """Return a new scene with one solid moved rigidly in the world frame. Raises KeyError for an unknown name."""
        old = self[name]
        new = replace(old, mesh=old.mesh.placed(target_from_source))
        scene = replace(self, objects=tuple(new if item is old else item for item in self.objects))
        return scene, Change(kind="move", name=name, before=old.mesh.bounds, after=new.mesh.bounds)

    def shifted(
        self, name: str, *, dx: float = 0.0, dy: float = 0.0, yaw: float = 0.0
    ) -> tuple[Scene, Change]:
        """Move a solid: turn it by `yaw` degrees about the vertical through the middle of its box, then shift it."""
        x, y, _ = self[name].mesh.bounds.mean(axis=0)
        return self.moved(name, rigid(x + dx, y + dy, yaw=yaw) @ rigid(-x, -y))

    @property
    def _highest_id(self) -> int:
        # An id is never given twice, so that the labels of two visits cannot be mixed up.
        return max([self.used_id, *(item.object_id for item in self.objects)])


def _caster_of(objects: Sequence[SceneObject]) -> Caster:
    starts = np.cumsum([0, *(len(item.mesh.vertices) for item in objects)])
    triangles = [item.mesh.triangles + start for item, start in zip(objects, starts, strict=False)]
    owners = [np.full(len(item.mesh.triangles), item.object_id, dtype=np.int32) for item in objects]
    vertices = np.concatenate([item.mesh.vertices for item in objects])
    return Caster(vertices, np.concatenate(triangles).astype(np.int32), np.concatenate(owners))


def _overlap(bounds: Floats, low: Floats, high: Floats) -> bool:
    return bool(np.all(bounds[0] < high - TOUCHING) and np.all(bounds[1] > low + TOUCHING))
