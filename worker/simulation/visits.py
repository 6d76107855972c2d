"""A visit: a robot goes its round through a scene and stands still for a scan at every stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from worker.cloud.formats.pcd import write_pcd
from worker.cloud.types import Floats, Matrix4, Points
from worker.simulation.company import CarrierBody, Walker, walkers
from worker.simulation.scenes import Scene, edit_kinds, random_edits, rigid
from worker.simulation.sensor import SensorModel, SimulatedScan, scan

SENSOR_HEIGHT = 0.35  #: metres above the floor
CLEARANCE = 0.25  #: metres between the sensor and anything else
#: The most that the benchmarks' priors are off by: metres over the floor, and degrees of yaw.
DRIFT = (0.25, 4.0)
#: Draws of edits, and what lies between the seeds of two: no visit's is as high.
DRAWS, NEXT_DRAW = 20, 100_000_000

#: How a belief about a pose comes to be off: from the pose, how far (metres, degrees), and random numbers.
Drift = Callable[[Matrix4, tuple[float, float], np.random.Generator], Matrix4]


def stops(scene: Scene, count: int, *, seed: int) -> tuple[Matrix4, ...]:
    """Return `count` poses, world_from_sensor, evenly along the scene's route and a little off it, looking ahead.

    Another seed gives other places (up to half a metre off), headings (sigma 12 degrees) and postures of the
    robot (sigma 0.5 degrees, 1 cm). Raises ValueError where the scene has no route or no free place beside it.
    """
    rng = np.random.default_rng([seed, 1])
    route = np.array(scene.route, dtype=np.float64).reshape(-1, 2)
    if len(route) < 2:
        raise ValueError(f"scene {scene.name} has no route")
    legs = np.linalg.norm(np.diff(route, axis=0), axis=1)
    reached = np.r_[0.0, np.cumsum(legs)]
    poses = []
    for share in (np.arange(count) + rng.uniform(0.3, 0.7, count)) / count:
        walked = share * reached[-1]
        leg = min(int(np.searchsorted(reached, walked, side="right")) - 1, len(legs) - 1)
        ahead = (route[leg + 1] - route[leg]) / max(legs[leg], 1e-9)
        x, y = _free_place(scene, route[leg] + (walked - reached[leg]) * ahead, rng)
        heading = float(np.degrees(np.arctan2(ahead[1], ahead[0]))) + rng.normal(0.0, 12.0)
        pitch, roll = rng.normal(0.0, 0.5, 2)
        height = SENSOR_HEIGHT + rng.normal(0.0, 0.01)
        poses.append(rigid(x, y, height, yaw=heading, pitch=float(pitch), roll=float(roll)))
    return tuple(poses)


def drifted(world_from_sensor: Matrix4, error: tuple[float, float], rng: np.random.Generator) -> Matrix4:
    """Shift a pose and turn it about its own place by errors of the given sigma (metres, degrees)."""
    metres, degrees = error
    shift = rng.normal(0.0, 1.0, 3) * metres * np.array([1.0, 1.0, 0.1])
    return _off_by(world_from_sensor, shift, yaw=float(rng.normal(0.0, 1.0)) * degrees)


def drifted_within(
    world_from_sensor: Matrix4, error: tuple[float, float], rng: np.random.Generator
) -> Matrix4:
    """Shift and turn a pose by errors of at most (metres, degrees): all up to them are equally likely.

    The length is that of the shift over the floor, in any direction; the height is off by at most a tenth.
    """
    metres, degrees = error
    length, towards = rng.uniform(0.0, metres), rng.uniform(0.0, 2 * np.pi)
    rise = rng.uniform(-0.1, 0.1) * metres
    shift = np.array([length * np.cos(towards), length * np.sin(towards), rise])
    return _off_by(world_from_sensor, shift, yaw=float(rng.uniform(-degrees, degrees)))


def visit(
    scene: Scene,
    poses: int | tuple[Matrix4, ...],
    *,
    seed: int,
    sensor: SensorModel | None = None,
    prior_error: tuple[float, float] = (0.0, 0.0),
    drift: Drift = drifted,
    duration_s: float = 5.0,
    folder: Path | None = None,
    name: str = "scan-{:02d}",
    people: int = 0,
    carrier: CarrierBody | None = None,
) -> tuple[SimulatedScan, ...]:
    """Simulate one scan a stop; `poses` are the stops (world_from_sensor) or how many to make along the route.

    Each scan's prior is off, independently of the others, by `prior_error` (metres, degrees of yaw): with
    `drifted` that is sigma, with `drifted_within` the most there can be. Each scan's noise depends on the seed
    and its place in the visit only. With a folder each scan is written there as PCD, its points in the sensor frame;
    `name` takes the scan's number, from 1. Past each stop walk `people`, other ones each time; `carrier` is what the
    sensor sees of its robot. Raises ValueError as `stops` does and for people without a route, OSError for the folder.
    """
    sensor = sensor or SensorModel()
    where = stops(scene, poses, seed=seed) if isinstance(poses, int) else poses
    scans = []
    for number, world_from_sensor in enumerate(where):
        rng = np.random.default_rng([seed, 2, number])
        passing = _passing(scene, world_from_sensor, people, seed, number)
        seen = scan(
            scene,
            world_from_sensor,
            duration_s=duration_s,
            sensor=sensor,
            rng=rng,
            walkers=passing,
            carrier=carrier,
        )
        path = None if folder is None else folder / f"{name.format(number + 1)}.pcd"
        if path is not None:
            write_pcd(path, seen.points)
        scans.append(replace(seen, prior=drift(world_from_sensor, prior_error, rng), path=path))
    return tuple(scans)


def _passing(
    scene: Scene, world_from_sensor: Matrix4, people: int, seed: int, number: int
) -> tuple[Walker, ...]:
    """Draw who walks by; from random numbers of their own, so that the scan's noise stays as it is without them."""
    if not people:
        return ()
    return walkers(scene, world_from_sensor, people, np.random.default_rng([seed, 6, number]))


def edited(scene: Scene, edits: int, *, seed: int, count: int) -> tuple[Scene, tuple[Matrix4, ...]]:
    """Add, remove and move `edits` things in turn; return the edited scene and `count` stops in it.

    Edits that leave a robot no way are drawn again. Raises ValueError where no draw leaves one.
    """
    return edited_by(lambda draw: random_edits(scene, seed=draw, kinds=edit_kinds(edits))[0], seed, count)


def edited_by(edit: Callable[[int], Scene], seed: int, count: int) -> tuple[Scene, tuple[Matrix4, ...]]:
    """Return the scene that `edit` makes of a seed, and `count` stops in it; with other seeds where it leaves no way.

    Raises ValueError where no draw leaves one.
    """
    blocked: ValueError | None = None
    for draw in range(DRAWS):
        after = edit(seed + draw * NEXT_DRAW)
        try:
            return after, stops(after, count, seed=seed)
        except ValueError as error:
            blocked = error
    raise blocked or ValueError("no draw was made")


def merged(scans: tuple[SimulatedScan, ...]) -> Points:
    """Return all points by the true poses, (N, 3) float32, world frame."""
    return np.concatenate([seen.world_points for seen in scans])


def _off_by(pose: Matrix4, shift: Floats, *, yaw: float) -> Matrix4:
    turn = rigid(yaw=yaw)
    prior = pose.copy()
    prior[:3, :3] = turn[:3, :3] @ prior[:3, :3]
    prior[:3, 3] += shift
    return prior


def _free_place(scene: Scene, wanted: Floats, rng: np.random.Generator) -> Floats:
    """Return the first random place (x, y) near the wanted one with room for a robot, looking ever farther away."""
    for reach in np.linspace(0.2, 1.5, 60):
        place: Floats = wanted + rng.uniform(-reach, reach, 2)
        if _has_room(scene, place):
            return place
    raise ValueError(f"scene {scene.name}: no free place for a robot around {wanted.round(2).tolist()}")


def _has_room(scene: Scene, place: Floats) -> bool:
    inside_room = any(np.all(place > room.low) and np.all(place < room.high) for room in scene.rooms)
    for item in scene.movable:  # not under a table, nor inside a cabinet
        low, high = item.mesh.bounds
        if low[2] < 1.0 and np.all(place > low[:2]) and np.all(place < high[:2]):
            return False
    # Distances to the surfaces themselves: the box around a wall would close its doorways.
    heights = np.array([[*place, z] for z in (SENSOR_HEIGHT, 0.7)])
    return inside_room and bool(scene.caster.distances(heights).min() > CLEARANCE)
