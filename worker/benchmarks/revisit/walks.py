"""What a second visit does: how the building is edited before it, where it stands, who is about."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from worker.benchmarks.revisit.plan import Case, RevisitSettings, VisitPlan
from worker.cloud.types import Matrix4
from worker.simulation.company import CarrierBody
from worker.simulation.hits import edited_things
from worker.simulation.scenes import Scene, edit_kinds, random_edits, random_solids
from worker.simulation.scenes.subtle import SMALL, nudges, sheets, taken_away, turns
from worker.simulation.visits import edited_by

IN_VIEW = 5.0  #: metres within which a single scan is hoped to see an edited thing

#: Makes the edited scene of the scene before, how many edits, and a seed.
Edit = Callable[[Scene, int, int], Scene]


def walk(plan: VisitPlan, before: Scene, settings: RevisitSettings) -> tuple[Scene, tuple[Matrix4, ...]]:
    """Return the scene as the visit finds it, and where it takes its scans (world_from_sensor).

    Raises ValueError where no edits leave a way.
    """
    edit, count = EDITS.get(plan.case, _pieces), plan.edits(settings)
    after, poses = edited_by(lambda seed: edit(before, count, seed), plan.seed, plan.stops(settings))
    if plan.case == "once":
        return after, poses[: max(1, round(len(poses) * settings.once_share))]
    if plan.case == "single":
        return after, (_best_view(before, after, poses),)
    return after, poses


def carrier_of(plan: VisitPlan) -> CarrierBody | None:
    """Return what the sensor sees of its robot, in the case of that name."""
    return CarrierBody.random(plan.seed) if plan.case == "carrier" else None


def push_of(plan: VisitPlan, settings: RevisitSettings) -> Matrix4:
    """Return the shift that a survey is pushed off by after registration, map frame; none in most cases.

    Its length is drawn within `settings.pushed`, its direction in all three axes, less of it upwards.
    """
    push = np.eye(4)
    if plan.case == "shifted":
        rng = np.random.default_rng([plan.seed, 15])
        toward = rng.normal(0.0, 1.0, 3) * [1.0, 1.0, 0.3]
        push[:3, 3] = rng.uniform(*settings.pushed) * toward / np.linalg.norm(toward)
    return push


def _pieces(before: Scene, count: int, seed: int) -> Scene:
    return random_edits(before, seed=seed, kinds=edit_kinds(count))[0]


def _small(before: Scene, count: int, seed: int) -> Scene:
    after, _ = taken_away(before, "small-", seed=seed, count=count // 2)
    after, _ = random_solids(
        after,
        seed=seed,
        count=count - count // 2,
        size=SMALL,
        places=("floor", "furniture"),
        name="new-small",
    )
    return after


def _sheets(before: Scene, count: int, seed: int) -> Scene:
    after, _ = taken_away(before, "sheet-", seed=seed, count=count // 2)
    return sheets(after, seed=seed, count=count - count // 2, name="new-sheet")[0]


def _nudged(before: Scene, count: int, seed: int) -> Scene:
    return nudges(before, seed=seed, count=count)[0]


def _turned(before: Scene, count: int, seed: int) -> Scene:
    return turns(before, seed=seed, count=count)[0]


#: How a case edits; all others add, remove and move pieces of furniture.
EDITS: dict[Case, Edit] = {"small": _small, "sheets": _sheets, "nudged": _nudged, "turned": _turned}


def _best_view(before: Scene, after: Scene, poses: tuple[Matrix4, ...]) -> Matrix4:
    """Return the stop from which most edited things are in front of the sensor, near, and behind nothing fixed.

    A single scan anywhere in a building would mostly see no edit at all.
    """
    ids = {thing.object_id for thing in edited_things(before, after)}
    middles = {
        item.object_id: item.mesh.bounds.mean(axis=0)
        for scene in (before, after)
        for item in scene.objects
        if item.object_id in ids
    }
    places = np.array(list(middles.values())).reshape(-1, 3)
    building = Scene(name="building", objects=tuple(item for item in after.objects if item.fixed))

    def in_view(pose: Matrix4) -> int:
        rays = places - pose[:3, 3]
        away = np.linalg.norm(rays, axis=1)
        unit = rays / np.maximum(away, 1e-9)[:, None]
        clear = building.caster.cast(pose[:3, 3], unit).ranges > away
        return int((clear & (unit @ pose[:3, 0] > 0) & (away < IN_VIEW)).sum())

    return max(poses, key=in_view)
