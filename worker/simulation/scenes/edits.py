"""Edits by chance, for benchmarks: what a second visit finds added, taken away or moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from worker.cloud.types import Floats
from worker.simulation.scenes.furniture import FREE_PIECES, WALL_PIECES
from worker.simulation.scenes.mesh import Mesh, box, cylinder
from worker.simulation.scenes.scene import Change, ChangeKind, Room, Scene, SceneObject

TRIES = 60  #: random places tried for one edit
NEAREST, FARTHEST = 0.3, 1.2  #: metres by which a piece is moved
Place = Literal["floor", "furniture", "air"]  #: where a solid comes to stand; `air` is at mid-height
PLACES: tuple[Place, ...] = get_args(Place)
SOLID_SIZE = (0.12, 1.20)  #: metres, the extents of a random solid
HEADROOM = 0.15  #: metres under the ceiling that stay free: lamps hang there
AIR = 0.3  #: metres over the floor from which on a solid stands at mid-height


def random_edits(
    scene: Scene, *, seed: int, kinds: Sequence[ChangeKind] = ("add", "remove", "move")
) -> tuple[Scene, tuple[Change, ...]]:
    """Make one edit for each entry of `kinds`, no object twice; pieces stay on the floor, in their room, and apart.

    An edit that finds no place is left out: count the changes that come back.
    """
    rng = np.random.default_rng([seed, 3])
    changes: list[Change] = []
    for number, kind in enumerate(kinds, start=1):
        touched = {change.name for change in changes}
        standing = [item for item in scene.movable if item.name not in touched and _stands(item)]
        if kind == "add":
            edited = _add(scene, f"new-{number}", rng)
        elif not standing:
            continue
        else:
            item = standing[int(rng.integers(len(standing)))]
            edited = scene.without(item.name) if kind == "remove" else _move(scene, item, rng)
        if edited is not None:
            scene, change = edited
            changes.append(change)
    return scene, tuple(changes)


def changed(scene: Scene, share: float, *, seed: int) -> Scene:
    """Return the scene with a share (0 to 1) of its movable standing furniture edited, as between two visits.

    In turn a piece is moved, taken away while another one comes elsewhere, or exchanged for another kind in its place.
    What finds no place is left as it was, or left out.
    """
    rng = np.random.default_rng([seed, 16])
    standing = [item for item in scene.movable if _stands(item)]
    count = int(share * len(standing) + rng.random())
    first = int(rng.integers(3))
    for number, chosen in enumerate(rng.permutation(len(standing))[:count].tolist()):
        item, way = standing[chosen], (first + number) % 3
        if way == 0:
            moved = _move(scene, item, rng)
            scene = scene if moved is None else moved[0]
            continue
        without, _ = scene.without(item.name)
        added = _exchanged(without, item, f"new-{number}", rng) if way == 2 else None
        added = added or _add(without, f"new-{number}", rng)
        scene = without if added is None else added[0]
    return scene


def _exchanged(
    scene: Scene, gone: SceneObject, prefix: str, rng: np.random.Generator
) -> tuple[Scene, Change] | None:
    """Stand a piece of another kind where one was taken away, turned at random; None where none fits."""
    pieces = {**WALL_PIECES, **FREE_PIECES}
    x, y = gone.mesh.bounds.mean(axis=0)[:2].tolist()
    for kind in rng.permutation([kind for kind in pieces if not gone.name.startswith(kind)]).tolist():
        mesh = pieces[kind]().at(x, y, yaw=float(rng.choice([0, 90, 180, 270])))
        if any(_within(room, mesh.bounds) for room in scene.rooms) and scene.is_free(mesh.bounds):
            return scene.with_added(f"{prefix}-{kind}", mesh)
    return None


def edit_kinds(count: int) -> tuple[ChangeKind, ...]:
    """Return `count` kinds of edits in turn: add, remove, move, add, ..."""
    kinds: tuple[ChangeKind, ...] = get_args(ChangeKind)
    return tuple(kinds[number % len(kinds)] for number in range(count))


def _add(scene: Scene, prefix: str, rng: np.random.Generator) -> tuple[Scene, Change] | None:
    pieces = {**WALL_PIECES, **FREE_PIECES}
    kind = str(rng.choice(list(pieces)))
    room = scene.rooms[int(rng.integers(len(scene.rooms)))]
    for _ in range(TRIES):
        x, y = rng.uniform(room.low, room.high)
        mesh = pieces[kind]().at(x, y, yaw=float(rng.uniform(0, 360)))
        if _within(room, mesh.bounds) and scene.is_free(mesh.bounds):
            return scene.with_added(f"{prefix}-{kind}", mesh)
    return None


def _move(scene: Scene, item: SceneObject, rng: np.random.Generator) -> tuple[Scene, Change] | None:
    room = next((room for room in scene.rooms if _within(room, item.mesh.bounds)), None)
    if room is None:
        return None
    for _ in range(TRIES):
        far, way = rng.uniform(NEAREST, FARTHEST), rng.uniform(0, 2 * np.pi)
        dx, dy, yaw = far * np.cos(way), far * np.sin(way), float(rng.uniform(-45, 45))
        moved, change = scene.shifted(item.name, dx=dx, dy=dy, yaw=yaw)
        bounds: Floats = moved[item.name].mesh.bounds
        if _within(room, bounds) and scene.is_free(bounds, ignoring=item.name):
            return moved, change
    return None


def _stands(item: SceneObject) -> bool:
    return float(item.mesh.bounds[0, 2]) < 0.01


def _within(room: Room, bounds: Floats) -> bool:
    return bool(np.all(bounds[0, :2] >= room.low) and np.all(bounds[1, :2] <= room.high))


def random_solids(
    scene: Scene,
    *,
    seed: int,
    count: int,
    size: tuple[float, float] = SOLID_SIZE,
    places: Sequence[Place] = PLACES,
    name: str = "solid",
) -> tuple[Scene, tuple[Change, ...]]:
    """Add `count` boxes, cylinders and pieces of furniture, each in a place drawn from `places`; `add` changes.

    The extents of boxes and cylinders are drawn between the two of `size` (metres), small ones as often as large;
    pieces of furniture are scaled so that their longest extent is. On the floor and at mid-height a solid keeps clear
    of everything; on furniture it rests on the highest spot under it. A solid that finds no place is left out.
    To have them removed instead, take the scene that comes back as the first visit's.
    Raises ValueError where an object has the name that one would get, as in `solid-1-box`.
    """
    rng = np.random.default_rng([seed, 4])
    before, changes = scene, []
    for number in range(1, count + 1):
        kind, mesh = _solid(rng, size)
        place = str(rng.choice(places))
        for _ in range(TRIES):
            turned = mesh.at(yaw=float(rng.uniform(0, 360)))
            standing = _stood(before, turned, place, rng)
            if standing is not None and _apart(scene, before, standing, place):
                scene, change = scene.with_added(f"{name}-{number}-{kind}", standing)
                changes.append(change)
                break
    return scene, tuple(changes)


def _solid(rng: np.random.Generator, size: tuple[float, float]) -> tuple[str, Mesh]:
    """Draw a shape, standing on z = 0, and what to call it."""

    def extent() -> float:
        return float(np.exp(rng.uniform(*np.log(size))))

    shape = rng.choice(["box", "cylinder", "piece"], p=[0.4, 0.3, 0.3])
    if shape == "box":
        return "box", box(extent(), extent(), extent())
    if shape == "cylinder":
        return "cylinder", cylinder(extent() / 2, extent())
    pieces = {**WALL_PIECES, **FREE_PIECES}
    kind = str(rng.choice(list(pieces)))
    mesh = pieces[kind]()
    low, high = mesh.bounds
    return kind, Mesh(vertices=mesh.vertices * (extent() / (high - low).max()), triangles=mesh.triangles)


def _stood(scene: Scene, mesh: Mesh, place: str, rng: np.random.Generator) -> Mesh | None:
    """Put a mesh somewhere in such a place of the scene; None where it does not fit into the room there."""
    room = scene.rooms[int(rng.integers(len(scene.rooms)))]
    low, high = np.array(room.low), np.array(room.high)
    if place == "furniture":
        below = scene.movable[int(rng.integers(len(scene.movable)))].mesh.bounds if scene.movable else None
        if below is None:
            return None
        low, high = below[0, :2], below[1, :2]
        room = next((room for room in scene.rooms if _within(room, below)), room)
    x, y = rng.uniform(low, high)
    tall = float(mesh.bounds[1, 2])
    most = room.height - HEADROOM - tall
    if place == "air":
        z = float(rng.uniform(AIR, most)) if most > AIR else None
    else:
        z = 0.0 if place == "floor" else _top(scene, mesh.at(x, y), room.height - HEADROOM)
    if z is None or z > most or (place == "furniture" and z < 0.1):
        return None
    standing = mesh.at(float(x), float(y), z)
    return standing if _within(room, standing.bounds) else None


def _top(scene: Scene, mesh: Mesh, ceiling: float) -> float | None:
    """Return the height of the highest surface under the mesh's footprint; None where that reaches the ceiling."""
    low, high = mesh.bounds
    x, y = (axis.ravel() for axis in np.meshgrid(*np.linspace(low[:2], high[:2], 6).T))
    origins = np.stack([x, y, np.full(len(x), ceiling)], axis=1)
    ranges = scene.caster.cast(origins, np.tile([0.0, 0.0, -1.0], (len(x), 1))).ranges
    return float(ceiling - ranges.min()) if np.isfinite(ranges).all() and ranges.min() > 1e-3 else None


def _apart(scene: Scene, before: Scene, mesh: Mesh, place: str) -> bool:
    """Tell whether it keeps clear of all boxes; on furniture, whose box may reach over it, of what was added."""
    if place != "furniture":
        return scene.is_free(mesh.bounds)
    old = {item.name for item in before.objects}
    added = tuple(item for item in scene.objects if item.name not in old)
    return Scene(name=scene.name, objects=added).is_free(mesh.bounds)
