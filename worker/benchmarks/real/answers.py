"""Answers: what a model says of two visits: objects with their voxels, a state a tile, and what it could judge."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.benchmarks.real.visits import RealScan, TwoVisits
from worker.cloud.fusing import fused_cloud
from worker.cloud.seen import Seen
from worker.cloud.tiling import TileGrid, grid_over
from worker.cloud.types import Floats, Indices
from worker.cloud.voxel_keys import Keys, packed, rows_of
from worker.cloud.voxels import Voxels
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detector
from worker.pipeline.alarms import calibrated, visits_of
from worker.pipeline.flow import compare, concluded
from worker.pipeline.mapping.fusion import CurrentMap, reference_map
from worker.pipeline.results.changes import TileState
from worker.pipeline.results.objects import ChangeObject, ChangeObjects
from worker.pipeline.settings import PipelineSettings


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class FoundObject:
    """An object that a model found."""

    change: ChangeObject
    before: Keys  #: (n,) ascending, its voxels of the map
    now: Keys  #: (m,) ascending, its voxels of the survey

    @property
    def voxels(self) -> int:
        """Of both visits."""
        return len(self.before) + len(self.now)

    def document(self) -> Document:
        """Return it as JSON."""
        return {
            "kind": self.change.kind,
            "voxels": [len(self.before), len(self.now)],
            "probability": round(self.change.probability, 3),
            "scans_seen_through": self.change.scans_seen_through,
            "places": [
                {
                    "center": list(place.center),
                    "size": list(place.size),
                    "points": place.points,
                    "height_over_floor": place.height_over_floor,
                }
                for place in self.change.places
            ],
        }


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Answer:
    """What a model says of two visits, with T tiles."""

    model: str
    grid: TileGrid
    tiles: Indices  #: (T, 3)
    scores: NDArray[np.float32]  #: (T,) probability of change, NaN where it says nothing
    states: NDArray[np.uint8]  #: (T,) values of TileState
    threshold: float  #: of tiles, the card's
    least_score: float  #: expected voxels of an object, by the map's own scans and the model's card
    objects: tuple[FoundObject, ...] | None  #: None where it scores tiles alone
    moving: int  #: things that moved during a visit
    judged: int  #: voxels of either visit that the other could judge
    voxels: int  #: in all
    seconds: float  #: from points to objects

    def counts(self) -> dict[str, int]:
        """Count the tiles by state."""
        counts = Counter(self.states.tolist())
        return {state.label: counts[state] for state in TileState}

    def document(self) -> Document:
        """Return it as JSON."""
        return {
            "model": self.model,
            "objects": None if self.objects is None else [one.document() for one in self.objects],
            "moving": self.moving,
            "least_score": round(self.least_score, 1),
            "tiles": self.counts(),
            "voxels_judged": self.judged if self.objects is not None else None,
            "voxels": self.voxels,
            "seconds": round(self.seconds, 2),
        }


def answer_of(detector: Detector, visits: TwoVisits) -> Answer:
    """Ask a model about two visits, as a survey of the service does. Raises MapFailed for clouds that are no building.

    A map of several scans first says how strong a change has to be.
    """
    settings = PipelineSettings().for_model(detector.card.preprocessing)
    limit = _least_score(detector, visits.first, settings)
    objects = settings.objects.with_values(min_score=limit)
    threshold = detector.card.threshold
    begun = time.perf_counter()
    comparison = comparison_of(visits.first, visits.second, settings)
    detection = detector.detect(comparison)
    told = concluded(
        comparison, detection, threshold=threshold, settings=settings.with_values(objects=objects)
    )
    return Answer(
        model=detector.card.model,
        grid=comparison.grid,
        tiles=comparison.tiles,
        scores=told.scores,
        states=told.states,
        threshold=threshold,
        least_score=limit,
        objects=None if told.objects is None else _objects(told.objects),
        moving=0 if told.objects is None else told.objects.moving,
        judged=0 if told.voxels is None else int(told.voxels.judged.sum()),
        voxels=0 if told.voxels is None else len(told.voxels.keys),
        seconds=time.perf_counter() - begun,
    )


def _least_score(detector: Detector, scans: Sequence[RealScan], settings: PipelineSettings) -> float:
    """Return the least score of an object by the map's own scans; 0 for a detector of tiles."""
    if detector.card.preprocessing.tiles != "touched":
        return 0.0
    size = settings.registration.voxel_size
    visits = visits_of((partial(_same, scan) for scan in scans), voxel_size=size)
    return calibrated(visits, detector, alarms_per_survey=settings.alarms_per_survey).min_score


def _same(scan: RealScan) -> RealScan:
    return scan


def comparison_of(
    first: Sequence[RealScan], second: Sequence[RealScan], settings: PipelineSettings
) -> Comparison:
    """Fuse both visits and set them side by side, with what their scans saw. Raises ValueError for no scan."""
    size = settings.registration.voxel_size
    clouds = [
        fused_cloud(Voxels.of(scan.points, size=size, origin=scan.sensor_origin) for scan in visit)
        for visit in (first, second)
    ]
    if clouds[0] is None or clouds[1] is None:
        raise ValueError("a visit without a scan cannot be compared")
    grid = grid_over(clouds[0].points, tile_size=settings.tiling.tile_size, voxel_size=size)
    return compare(
        reference_map(clouds[0], grid=grid, settings=settings.registration),
        CurrentMap(points=clouds[1].points, colors=None),
        settings=settings,
        reference_seen=Seen.of(first, voxel_size=size),
        current_seen=Seen.of(second, voxel_size=size),
    )


def _objects(told: ChangeObjects) -> tuple[FoundObject, ...]:
    return tuple(
        FoundObject(
            change=thing,
            before=told.keys[told.before == thing.number],
            now=told.keys[told.now == thing.number],
        )
        for thing in told.objects
    )


def tiles_of(points: Floats, grid: TileGrid) -> Indices:
    """Return (N, 3) the tile that each point (N, 3) lies in, within the grid's box or not."""
    return np.asarray(np.floor((points - grid.origin) / grid.size), np.int32)


def scores_at(answer: Answer, tiles: Indices) -> Floats:
    """Return the score of each of other tiles (n, 3); 0 where the model says nothing of one."""
    told = np.flatnonzero((answer.states != TileState.UNOBSERVED) & ~np.isnan(answer.scores))
    keys = packed(answer.tiles[told])
    order = np.argsort(keys)
    rows = rows_of(packed(tiles), keys[order])
    scores = answer.scores[told][order].astype(np.float64)
    return np.append(scores, 0.0)[rows]
