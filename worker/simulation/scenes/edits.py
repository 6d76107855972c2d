"""Edits by chance, for benchmarks: what a second visit finds added, taken away or moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np

from worker.cloud.types import Floats
from worker.simulation.scenes.furniture import FREE_PIECES, WALL_PIECES
from worker.simulation.scenes.scene import Change, ChangeKind, Room, Scene, SceneObject

TRIES = 60  #: random places tried for one edit
NEAREST, FARTHEST = 0.3, 1.2  #: metres by which a piece is moved


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
