"""What stands in a robot's view and belongs to no building: people who walk by, and parts of the robot itself.

Their object ids are below zero, so that nobody takes them for an object of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from worker.cloud.types import Floats, Matrix4
from worker.simulation.scenes.caster import Caster, Hits
from worker.simulation.scenes.mesh import Mesh, block, cylinder, sphere, turned, union
from worker.simulation.scenes.scene import Scene

CARRIER_ID = -1  #: of returns from the robot that carries the sensor
FIRST_PERSON_ID = -2  #: of the first person; the next ones count down
PACE = (0.6, 1.4)  #: metres a second
ASIDE = 0.35  #: metres that a person walks off the robot's route, at most
ROOM_TO_ROBOT = 0.4  #: metres; nobody comes nearer to the sensor
NEARBY = 5.0  #: metres from the sensor within which a person's walk begins


@dataclass(frozen=True, kw_only=True, eq=False)
class Walker:
    """A person who walks through the view of one scan."""

    object_id: int
    way: Floats  #: (W, 2) metres, world frame, x and y of the waypoints
    start: float  #: metres along the way when the scan begins
    pace: float  #: metres a second, below zero for walking back

    def cast(self, origin: Floats, rays: Floats, seconds: Floats) -> Hits:
        """Cast rays (N, 3), unit length, from one origin (3,), world frame, each at its time (N,) in the scan.

        The person has moved on from ray to ray, and so is smeared along the way.
        """
        place, ahead = self.at(seconds)
        away = origin[:2] - place
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)

        def in_body(vectors: Floats, z: Floats) -> Floats:
            return np.stack([(vectors * ahead).sum(axis=1), (vectors * left).sum(axis=1), z], axis=1)

        origins = in_body(away, np.full(len(rays), origin[2]))
        hits = _body_caster().cast(origins, in_body(rays[:, :2], rays[:, 2]))
        met = (hits.object_ids > 0) & (np.linalg.norm(away, axis=1) > ROOM_TO_ROBOT)
        return Hits(
            ranges=np.where(met, hits.ranges, np.inf),
            cosines=np.where(met, hits.cosines, 0.0),
            object_ids=np.where(met, self.object_id, 0).astype(np.int32),
        )

    def at(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Return where the person is at these times (N,) and looks to: (N, 2) metres, (N, 2) unit length."""
        legs = self._legs
        reached = np.r_[0.0, np.cumsum(np.linalg.norm(legs, axis=1))]
        walked = np.mod(self.start + self.pace * seconds, 2 * reached[-1])
        walked = reached[-1] - np.abs(reached[-1] - walked)  # turns round at either end
        leg = np.clip(np.searchsorted(reached, walked, side="right") - 1, 0, len(legs) - 1)
        ahead = legs[leg] / np.linalg.norm(legs[leg], axis=1, keepdims=True)
        place = self.way[leg] + (walked - reached[leg])[:, None] * ahead
        return place, ahead if self.pace >= 0 else -ahead

    @cached_property
    def _legs(self) -> Floats:
        legs: Floats = np.diff(self.way, axis=0)
        return legs


def walkers(
    scene: Scene, world_from_sensor: Matrix4, count: int, rng: np.random.Generator
) -> tuple[Walker, ...]:
    """Let `count` people walk along the scene's route, a little aside, past a sensor. Raises ValueError without route."""
    way = np.array(scene.route, np.float64).reshape(-1, 2)
    way = way[np.r_[True, np.linalg.norm(np.diff(way, axis=0), axis=1) > 1e-6]] if len(way) else way
    if len(way) < 2:
        raise ValueError(f"scene {scene.name} has no route that people could walk along")
    reached = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))]
    every = np.linspace(0.0, reached[-1], 400)
    places = np.stack([np.interp(every, reached, axis) for axis in way.T], axis=1)
    off = np.linalg.norm(places - world_from_sensor[:2, 3], axis=1)
    near = every[off < max(NEARBY, float(off.min()) + 0.5)]
    return tuple(
        Walker(
            object_id=FIRST_PERSON_ID - number,
            way=way + rng.uniform(-ASIDE, ASIDE, 2),
            start=float(rng.choice(near)),
            pace=float(rng.uniform(*PACE) * rng.choice([-1, 1])),
        )
        for number in range(count)
    )


def person(height: float = 1.75) -> Mesh:
    """Build two legs, a trunk, arms and a head; standing on z = 0, looking along x."""
    legs = [cylinder(0.08, 0.85, sides=10).at(step, side) for step, side in ((0.15, 0.1), (-0.15, -0.1))]
    trunk = turned([(0.0, 0.8), (0.17, 0.82), (0.21, 1.3), (0.1, height - 0.28), (0.0, height - 0.28)])
    arms = [cylinder(0.05, 0.6, sides=8).at(0.0, side, 0.8) for side in (-0.25, 0.25)]
    return union(*legs, trunk, *arms, sphere(0.12).at(z=height - 0.26))


@cache
def _body_caster() -> Caster:
    mesh = person()
    return Caster(mesh.vertices, mesh.triangles, np.ones(len(mesh.triangles), np.int32))


@dataclass(frozen=True, kw_only=True, eq=False)
class CarrierBody:
    """The parts of a robot that its own sensor sees: they stand at the same place in every scan."""

    mesh: Mesh  #: sensor frame

    @classmethod
    def random(cls, seed: int) -> CarrierBody:
        """Draw a robot with a deck ahead of the sensor and a mast beside it, all 20 to 70 cm from the sensor."""
        rng = np.random.default_rng([seed, 8])
        wide, first, low = (
            float(rng.uniform(0.1, 0.3)),
            float(rng.uniform(0.2, 0.3)),
            -float(rng.uniform(0.18, 0.25)),
        )
        last = first + float(rng.uniform(0.12, 0.25))
        deck = block((first, -wide / 2, low - 0.03), (last, wide / 2, low))
        away, side = float(rng.uniform(0.28, 0.45)), np.radians(rng.uniform(25, 75) * rng.choice([-1, 1]))
        mast = cylinder(float(rng.uniform(0.015, 0.03)), 0.55, sides=12)
        return cls(mesh=union(deck, mast.at(away * np.cos(side), away * np.sin(side), -0.25)))

    def cast(self, rays: Floats) -> Hits:
        """Cast rays (N, 3), unit length, sensor frame, from its origin."""
        return self._caster.cast(np.zeros(3), rays)

    @cached_property
    def _caster(self) -> Caster:
        return Caster(
            self.mesh.vertices, self.mesh.triangles, np.full(len(self.mesh.triangles), CARRIER_ID, np.int32)
        )
