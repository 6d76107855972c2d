"""What a method says of a second visit: a score for every tile, and where it tells voxels, the objects made of them."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worker.benchmarks.methods import RevisitMethod
from worker.benchmarks.revisit.calibration import Reliability, voxel_reliability
from worker.benchmarks.revisit.plan import SitePlan, VisitPlan
from worker.benchmarks.revisit.visits import Revisit, RevisitSite, load_parts, load_site
from worker.cloud.types import Floats, Indices
from worker.cloud.voxel_keys import Keys, packed, rows_of
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detection, VoxelScores
from worker.pipeline.alarms import calibrated
from worker.pipeline.flow import compare
from worker.pipeline.mapping.fusion import CurrentMap
from worker.pipeline.results.objects import ObjectSettings, change_objects
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress
from worker.simulation.hits import Visit


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PredictedObject:
    """A thing that a method says appeared, disappeared or moved."""

    kind: str  #: appeared, disappeared or moved
    before: Keys  #: (n,) ascending, voxels of the map's returns that belong to it
    now: Keys  #: (n,) ascending, of the survey's
    probability: float  #: mean over its voxels

    def keys_in(self, visit: Visit) -> Keys:
        """Return the voxels in which it stood in that visit."""
        return self.before if visit is Visit.FIRST else self.now

    @property
    def keys(self) -> Keys:
        """(n,) ascending, of both visits."""
        return np.union1d(self.before, self.now)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VisitAnswer:
    """What a method said of one visit with T tiles."""

    scores: Floats  #: (T,) the higher the more changed; NaN where it has no tile or calls it unobserved
    objects: tuple[PredictedObject, ...] | None  #: None where it scores tiles alone
    reliability: Reliability | None  #: of its voxels' probabilities


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Answers:
    """What a method said of some visits."""

    visits: tuple[VisitAnswer, ...]
    seconds: float  #: for all of them, from the clouds and what was seen to tiles and objects
    limits: tuple[
        float, ...
    ] = ()  #: on each map in turn, the least score of an object by the map's own scans


def answers_of(
    method: RevisitMethod,
    plans: Sequence[VisitPlan],
    visits: Sequence[Revisit],
    place: Path,
    settings: PipelineSettings,
    progress: Progress = no_progress,
) -> Answers:
    """Ask of every visit, against the clock; the maps lie in `place`."""
    answers: list[VisitAnswer] = []
    limits: list[float] = []
    seconds = 0.0
    pairs = zip(plans, visits, strict=True)
    for site_plan, group in itertools.groupby(pairs, key=lambda pair: pair[0].site):
        site = load_site(site_plan, place)
        progress(f"scoring: {method.name}", len(answers) / len(visits))
        objects_as = _object_settings(method, site_plan, place, settings)
        limits.append(objects_as.min_score)
        for _, revisit in group:
            progress(f"scoring: {method.name}", len(answers) / len(visits))
            begun = time.perf_counter()
            comparison, detection, objects = _asked(method, site, revisit, settings, objects_as)
            seconds += time.perf_counter() - begun
            answers.append(_answer(site, revisit, comparison, detection, objects))
    return Answers(visits=tuple(answers), seconds=seconds, limits=tuple(limits))


def _object_settings(
    method: RevisitMethod, plan: SitePlan, place: Path, settings: PipelineSettings
) -> ObjectSettings:
    """Return what the method takes for an object on this map, by the map's own scans, as when a map is built."""
    if method.detector is None or not method.tells_voxels:
        return ObjectSettings()
    found = calibrated(load_parts(plan, place), method.detector, alarms_per_survey=settings.alarms_per_survey)
    return ObjectSettings(min_score=found.min_score)


def comparison_of(
    site: RevisitSite, revisit: Revisit, settings: PipelineSettings, method: RevisitMethod
) -> Comparison:
    """Set a map and a survey side by side, cut along the tiles that the method takes."""
    tiling = settings.tiling.with_values(tiles=method.tiles, min_points=method.min_points)
    return compare(
        site.reference,
        CurrentMap(points=revisit.points, colors=None),
        settings=settings.with_values(tiling=tiling),
        reference_seen=site.seen,
        current_seen=revisit.seen,
    )


def tile_scores_of(tiles: Indices, told: Indices, scores: Floats) -> Floats:
    """Return the score of each of the tiles (T, 3), from those of other tiles (t, 3) and (t,); NaN where none is."""
    keys = packed(told)
    order = np.argsort(keys)
    rows = rows_of(packed(tiles), keys[order])
    found: Floats = np.full(len(tiles), np.nan)
    found[rows >= 0] = scores[order][rows[rows >= 0]]
    return found


def _asked(
    method: RevisitMethod,
    site: RevisitSite,
    revisit: Revisit,
    settings: PipelineSettings,
    objects_as: ObjectSettings,
) -> tuple[Comparison, Detection | None, tuple[PredictedObject, ...] | None]:
    comparison = comparison_of(site, revisit, settings, method)
    if not len(revisit.points):
        return comparison, None, () if method.tells_voxels else None
    detection = method.detect(comparison)
    return comparison, detection, _objects(comparison, detection.voxels, objects_as)


def _objects(
    comparison: Comparison, voxels: VoxelScores | None, settings: ObjectSettings
) -> tuple[PredictedObject, ...] | None:
    if voxels is None:
        return None
    told = change_objects(comparison, voxels, settings)
    return tuple(
        PredictedObject(
            kind=thing.kind,
            before=told.keys[told.before == thing.number],
            now=told.keys[told.now == thing.number],
            probability=thing.probability,
        )
        for thing in told.objects
    )


def _answer(
    site: RevisitSite,
    revisit: Revisit,
    comparison: Comparison,
    detection: Detection | None,
    objects: tuple[PredictedObject, ...] | None,
) -> VisitAnswer:
    if detection is None:
        return VisitAnswer(scores=np.full(len(revisit.tiles), np.nan), objects=objects, reliability=None)
    scores = tile_scores_of(revisit.tiles, comparison.tiles, detection.change.astype(np.float64))
    voxels = detection.voxels
    reliability = (
        None if voxels is None else voxel_reliability(voxels, revisit.truth, site.seen, revisit.seen)
    )
    return VisitAnswer(scores=scores, objects=objects, reliability=reliability)
