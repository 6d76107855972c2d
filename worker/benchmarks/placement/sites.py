"""The maps: each place is walked, mapped with drifted priors as the product does, and kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worker.benchmarks.placement.plan import PlacementSettings, SitePlan
from worker.benchmarks.trajectory import map_frame, scan_files
from worker.cloud import npz
from worker.cloud.seen import Seen
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.flow import build_map
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.simulation.scenes import Scene, rigid
from worker.simulation.visits import drifted_within, stops, visit

SITES = "sites"  #: folder of the maps
NEAR_END = 0.5  #: share of the longest side of a place that a map of half of it is of


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacementSite:
    """A place's map, as the pipeline made it."""

    name: str
    reference: ReferenceMap
    seen: Seen  #: what its scans saw
    map_from_world: Matrix4  #: (4, 4) by the best fit of all poses: a map has the frame of its priors
    stops: Floats  #: (S, 4, 4) world_from_sensor of the scans that it was built of


def make_site(plan: SitePlan, settings: PlacementSettings, folder: Path) -> Path:
    """Build the map of a place where the folder lacks it; return its file. Raises MapFailed, OSError."""
    kept = folder / settings.fingerprint / SITES / f"{plan.name}.npz"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        npz.save(kept, mapped(plan, settings))
    return kept


def load_site(plan: SitePlan, settings: PlacementSettings, folder: Path) -> PlacementSite:
    """Read the map of a place, and build it first where the folder lacks it. Raises as `make_site` does."""
    return _loaded(make_site(plan, settings, folder))


@lru_cache(maxsize=2)
def _loaded(kept: Path) -> PlacementSite:
    return npz.load(kept, PlacementSite)


def mapped(plan: SitePlan, settings: PlacementSettings) -> PlacementSite:
    """Simulate the first visit and build its map. Raises MapFailed.

    The robot's own frame is turned at random against the building: no wall runs along the tiles but by chance.
    """
    scene, seed = plan.scene(), 20 * plan.seed
    poses = map_stops(plan, scene, settings)
    with TemporaryDirectory(prefix="spicd-placement-") as scratch:
        taken = visit(
            scene,
            poses,
            seed=seed,
            prior_error=settings.drift,
            drift=drifted_within,
            duration_s=settings.standing_s,
            folder=Path(scratch),
            name="map-{:02d}",
        )
        rng = np.random.default_rng([plan.seed, 5])
        robot_from_world = rigid(*rng.uniform(-3, 3, 2), yaw=float(rng.uniform(0, 360)))
        built = build_map(scan_files(taken, robot_from_world), settings=settings.pipeline, processes=1)
    return PlacementSite(
        name=plan.name,
        reference=built.reference,
        seen=built.seen,
        map_from_world=map_frame(built.outcomes, taken),
        stops=np.stack([scan.world_from_sensor for scan in taken]),
    )


def map_stops(plan: SitePlan, scene: Scene, settings: PlacementSettings) -> tuple[Matrix4, ...]:
    """Return where the map's scans are taken (world_from_sensor); of half a place those near its low end."""
    poses = stops(scene, settings.stops[plan.kind], seed=20 * plan.seed)
    return near_low_end(scene, poses) if plan.half else poses


def near_low_end(scene: Scene, poses: Sequence[Matrix4]) -> tuple[Matrix4, ...]:
    """Keep the poses in the lower half along x."""
    low, high = scene.bounds[:, 0]
    return tuple(pose for pose in poses if pose[0, 3] < low + NEAR_END * (high - low))
