"""A spinning LiDAR with a rocking beam, after the Unitree L1: one scan of a scene (docs/simulator.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Floats, Matrix4, Points
from worker.simulation.company import CarrierBody, Walker
from worker.simulation.scenes.caster import Hits, chosen, nearest
from worker.simulation.scenes.scene import Scene

TURN = 360.0  #: degrees
LEAST_GAP = 0.03  #: metres between two surfaces that a beam can mix
NOWHERE = 1000.0  #: metres, the range of a ray that meets nothing: beyond every limit, and finite


@dataclass(frozen=True, kw_only=True, slots=True)
class SensorModel:
    """Rates and angles as the maker states them; noise as measured or assumed, see docs/simulator.md."""

    points_per_second: float = 21_600.0
    turns_per_second: float = 11.0  #: Hz, about the axis
    lines_per_second: float = 180.0  #: Hz, sweeps of the mirror from edge to edge of the field
    rate_jitter: float = 0.02  #: share, sigma of the turn between two lines
    field_deg: float = 180.0  #: degrees swept by a line through the axis; 180 is 90 degrees to either side
    axis_elevation_deg: float = 30.0  #: of the axis above the sensor's x, in which the field is centred
    min_range: float = 0.05  #: metres
    max_range: float = 15.0  #: metres
    range_sigma: float = 0.015  #: metres, each point
    bias_sigma: float = 0.005  #: metres, one draw a scan
    range_step: float = 0.001  #: metres, ranges are rounded to this; 0 leaves them
    angle_sigma_deg: float = 0.05  #: degrees, between the true and the reported direction, each of two angles
    beam_deg: float = 0.15  #: degrees, radius of the beam: what it half covers mixes
    mixing: float = 0.5  #: share of the points on an edge of depth that fall between both surfaces
    mixing_depth: float = 0.6  #: metres, surfaces farther apart give two pulses, of which the first counts
    certain_range: float = 4.0  #: metres, every return arrives up to here
    faint_range: float = 10.0  #: metres, `faint_share` of the returns arrives here; the fall is linear
    faint_share: float = 0.2
    loss: float = 0.06  #: share lost at random
    glass_share: float = 0.05  #: of the pulses that a pane sends back, from any direction
    glass_glint: float = 0.5  #: share that it sends back besides, met within `glint_deg` of its normal
    glint_deg: float = 10.0
    grazing_deg: float = 75.0  #: degrees from the normal from which returns grow fewer, down to none at 90


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SimulatedScan:
    """What a standing sensor returned, and the truth about it."""

    points: Points  #: (N, 3) float32, metres, sensor frame: x ahead, y left, z up
    #: (N,) object that the middle of the beam met; below zero for people and the robot itself (company.py)
    object_ids: NDArray[np.int32]
    world_from_sensor: Matrix4  #: (4, 4) the true pose
    #: (4, 4) world_from_sensor as the robot believes it; the true pose unless a visit drifts it
    prior: Matrix4
    path: Path | None = None  #: of the PCD file with these points, where a visit was asked to write one

    @property
    def world_points(self) -> Points:
        """(N, 3) float32, world frame, by the true pose."""
        rotated = self.points @ self.world_from_sensor[:3, :3].T
        return (rotated + self.world_from_sensor[:3, 3]).astype(np.float32)


#: No noise and no loss: every ray that meets something within range comes back exact.
PERFECT = SensorModel(
    rate_jitter=0.0,
    range_sigma=0.0,
    bias_sigma=0.0,
    range_step=0.0,
    angle_sigma_deg=0.0,
    mixing=0.0,
    faint_share=1.0,
    loss=0.0,
    grazing_deg=90.0,
)


def scan(
    scene: Scene,
    world_from_sensor: Matrix4,
    *,
    duration_s: float = 5.0,
    sensor: SensorModel,
    rng: np.random.Generator,
    walkers: Sequence[Walker] = (),
    carrier: CarrierBody | None = None,
) -> SimulatedScan:
    """Stand for `duration_s` seconds at a pose and measure. One cast of all rays; the same rng state, the same scan.

    People who walk by and parts of the robot hide what is behind them; noise and losses are drawn as without them.
    """
    reported = directions(sensor, duration_s, rng)  # (N, 3) sensor frame
    fired = _perturbed(reported, sensor.angle_sigma_deg, rng)
    edge = _perturbed(fired, sensor.beam_deg, rng)
    both = np.concatenate([fired, edge])  # (2N, 3)
    hit = _first_hits(scene, world_from_sensor, both, duration_s, walkers, carrier)
    hit = _past_gloss(scene, world_from_sensor, both, hit, sensor, rng)
    count = len(reported)
    first, other = np.split(np.minimum(hit.ranges, NOWHERE), 2)
    mixed = _mixed(first, other, hit.cosines[:count], sensor, rng)
    kept = _returned(first, hit.cosines[:count], sensor, rng)
    noisy = mixed + rng.normal(0.0, sensor.bias_sigma) + rng.normal(0.0, sensor.range_sigma, count)
    if sensor.range_step > 0:
        noisy = np.round(noisy / sensor.range_step) * sensor.range_step
    kept &= (noisy >= sensor.min_range) & (noisy <= sensor.max_range)
    return SimulatedScan(
        points=(reported[kept] * noisy[kept, None]).astype(np.float32),
        object_ids=hit.object_ids[:count][kept],
        world_from_sensor=world_from_sensor,
        prior=world_from_sensor,
    )


def directions(sensor: SensorModel, duration_s: float, rng: np.random.Generator) -> Floats:
    """Return unit vectors (N, 3), sensor frame, in the order in which they are fired.

    A line sweeps the field through the axis while the head turns on; its phase and the turn to the next line
    are jittered, so that no two scans, nor two lines, meet the same spots.
    """
    per_line = round(sensor.points_per_second / sensor.lines_per_second)
    lines = max(1, round(duration_s * sensor.lines_per_second))
    turn = TURN * sensor.turns_per_second / sensor.lines_per_second  # degrees the head moves on during a line
    turns = turn * (1 + rng.normal(0.0, sensor.rate_jitter, lines))
    start = rng.uniform(0, TURN) + np.cumsum(turns) - turns
    share = (np.arange(per_line)[None, :] + rng.random((lines, 1))) / per_line  # (lines, per_line) 0..1
    azimuth = np.radians(start[:, None] + turns[:, None] * share).ravel()
    off_axis = np.radians((share - 0.5) * sensor.field_deg).ravel()
    tilt = np.radians(sensor.axis_elevation_deg)
    axis, side, up = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    around = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * up
    rays: Floats = np.cos(off_axis)[:, None] * axis + np.sin(off_axis)[:, None] * around
    return rays


def _first_hits(
    scene: Scene,
    world_from_sensor: Matrix4,
    rays: Floats,
    duration_s: float,
    walkers: Sequence[Walker],
    carrier: CarrierBody | None,
) -> Hits:
    """Cast rays (2N, 3), sensor frame, the second half fired at the same times as the first; glass is air."""
    origin = world_from_sensor[:3, 3]
    turned = rays @ world_from_sensor[:3, :3].T
    hits = scene.opaque.cast(origin, turned)
    seconds = np.tile(np.linspace(0.0, duration_s, len(rays) // 2, endpoint=False), 2)
    for walker in walkers:
        hits = nearest(hits, walker.cast(origin, turned, seconds))
    return hits if carrier is None else nearest(hits, carrier.cast(rays))


def _past_gloss(
    scene: Scene,
    world_from_sensor: Matrix4,
    rays: Floats,
    hits: Hits,
    sensor: SensorModel,
    rng: np.random.Generator,
) -> Hits:
    """Turn the rays (2N, 3), sensor frame, that met a mirror, and send a few back from panes of glass.

    What a mirror shows lies behind it, as far as the whole way was, under the mirror's id. A ray is turned once; what
    it meets then sends it back, be it glass or another mirror. Scenes without either draw no random number here.
    """
    if not scene.mirror_ids and scene.glass is None:
        return hits
    origin, turned = world_from_sensor[:3, 3], rays @ world_from_sensor[:3, :3].T
    first = hits.ranges
    if scene.mirror_ids:
        hits = _mirrored(scene, origin, turned, hits)
    if scene.glass is not None:
        panes = scene.glass.cast(origin, turned)
        glint = panes.cosines > np.cos(np.radians(sensor.glint_deg))
        chance = sensor.glass_share + sensor.glass_glint * glint
        back = np.tile(rng.random(len(rays) // 2), 2) < chance
        hits = chosen(back & (panes.ranges < first), panes, hits)
    return hits


def _mirrored(scene: Scene, origin: Floats, rays: Floats, hits: Hits) -> Hits:
    """Send the rays (N, 3), world frame, that met a mirror on to what it shows."""
    met = np.flatnonzero(np.isin(hits.object_ids, scene.mirror_ids))
    if hits.normals is None or not len(met):
        return hits
    normals, fired = hits.normals[met], rays[met]
    turned = fired - 2 * np.einsum("ij,ij->i", fired, normals)[:, None] * normals
    places = origin + hits.ranges[met, None] * fired + 1e-4 * turned
    shown = scene.opaque.cast(places, turned)
    ranges, cosines = hits.ranges.copy(), hits.cosines.copy()
    ranges[met] += shown.ranges
    cosines[met] = shown.cosines
    return Hits(ranges=ranges, cosines=cosines, object_ids=hits.object_ids, normals=hits.normals)


def _perturbed(rays: Floats, sigma_deg: float, rng: np.random.Generator) -> Floats:
    """Tilt the rays at random; what the noise adds along the ray is lost in the normalisation."""
    tilted = rays + rng.normal(0.0, np.radians(sigma_deg), rays.shape)
    unit: Floats = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    return unit


def _mixed(
    first: Floats, other: Floats, cosines: Floats, sensor: SensorModel, rng: np.random.Generator
) -> Floats:
    """Return ranges (N,); where the beam straddles an edge, some lie between both surfaces."""
    gap = np.abs(other - first)
    # On one plane the range changes by about r * angle * tan(incidence) across the beam: that is no edge.
    cosines = np.clip(cosines, 0.05, 1.0)
    plane = first * np.radians(3 * sensor.beam_deg) * np.sqrt(1 - cosines**2) / cosines
    edge = (gap > LEAST_GAP + plane) & (gap < sensor.mixing_depth) & (rng.random(len(first)) < sensor.mixing)
    between = first + rng.random(len(first)) * (other - first)
    return np.where(edge, between, first)


def _returned(
    ranges: Floats, cosines: Floats, sensor: SensorModel, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Tell which rays come back at all: (N,)"""
    slope = (1 - sensor.faint_share) / (sensor.faint_range - sensor.certain_range)
    far = np.clip(1 - slope * (ranges - sensor.certain_range), 0.0, 1.0)
    grazing = np.cos(np.radians(sensor.grazing_deg))
    flat = np.clip(cosines / grazing, 0.0, 1.0) if grazing > 1e-6 else 1.0
    chance = far * flat * (1 - sensor.loss)
    arrived: NDArray[np.bool_] = rng.random(len(ranges)) < chance
    return arrived
