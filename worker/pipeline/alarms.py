"""False alarms: how strong a region of changed voxels has to be on a certain map, so that they stay rare.

A map's own scans, parted in several visits, are surveys in which nothing changed: whatever a detector finds in one of
them, held against the rest, is a false alarm. They are few, so the card's record of quiet surveys elsewhere weighs in.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from worker.cloud.seen import PlacedScan, Seen
from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.cloud.types import Floats
from worker.detectors.card import QuietRecord
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detector
from worker.pipeline.results.objects import ObjectSettings, regions_of
from worker.progress import Progress, no_progress

ALARMS_PER_SURVEY = 0.1  #: false objects that a client accepts if nothing else is asked for
PARTS = 6  #: that a map's scans are parted in, at most
MOST = 150.0  #: expected voxels; a stronger region is always an object, however noisy the map
_WEIGHT = 10.0  # surveys of the map's own that the card's record counts for


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class AlarmCalibration:
    """What a detector found on a map where there was nothing to find, and the limit that follows from it."""

    surveys: int  #: parts of the map's own scans that were held against the rest
    false_scores: Floats  #: (F,) scores of the regions found in them, descending
    alarms_per_survey: float  #: asked for
    min_score: float  #: expected changed voxels of a region, from which it is an object


def visits_of(
    scans: Iterable[Callable[[], PlacedScan]], *, voxel_size: float, parts: int = PARTS
) -> list[Seen]:
    """Part a map's scans in visits of every `parts`-th scan each; one scan is held at a time."""
    visits: list[Seen] = []
    for number, load in enumerate(scans):
        seen = Seen.of([load()], voxel_size=voxel_size)
        if number < parts:
            visits.append(seen)
        else:
            visits[number % parts] = visits[number % parts].merged(seen)
    return visits


def calibrated(
    visits: Sequence[Seen],
    detector: Detector,
    *,
    alarms_per_survey: float = ALARMS_PER_SURVEY,
    progress: Progress = no_progress,
) -> AlarmCalibration:
    """Hold each visit against all others, and choose the least limit that keeps alarms as rare as asked.

    Of a single visit nothing can be learned; the limit is then the card's.
    """
    scores: list[float] = []
    surveys = len(visits) if len(visits) > 1 else 0
    for number in range(surveys):
        progress("calibrating", number / surveys)
        scores += region_scores(detector, rest_of(visits, number), visits[number])
    progress("calibrating", 1.0)
    false = np.array(sorted(scores, reverse=True))
    return AlarmCalibration(
        surveys=surveys,
        false_scores=false,
        alarms_per_survey=alarms_per_survey,
        min_score=least_score(false, surveys, detector.card.quiet, alarms_per_survey),
    )


def rest_of(visits: Sequence[Seen], number: int) -> Seen:
    """Return what all visits but one saw together."""
    rest = [visit for other, visit in enumerate(visits) if other != number]
    return functools.reduce(Seen.merged, rest)


def region_scores(detector: Detector, reference: Seen, current: Seen) -> list[float]:
    """Return the scores of all regions that the detector finds, of both kinds, before any limit on the score."""
    detection = detector.detect(_without_tiles(reference, current))
    if detection.voxels is None:
        return []
    found = [
        regions_of(detection.voxels, chances, ObjectSettings())
        for chances in (detection.voxels.appeared, detection.voxels.disappeared)
    ]
    return [region.score for regions in found for region in regions]


def least_score(false: Floats, surveys: int, record: QuietRecord | None, alarms_per_survey: float) -> float:
    """Return the least score above which false regions are as rare as asked.

    The rate above a score is that of the map's own surveys and of the card's together, the latter as if it had been
    10 surveys. With a record of neither there is no limit (0); it is never above 150 expected voxels.
    """
    weight = 0.0 if record is None else _WEIGHT
    if surveys + weight == 0:
        return 0.0
    elsewhere = np.array([] if record is None else record.scores)
    per_survey = weight / max(1 if record is None else record.surveys, 1)
    for score in np.unique(np.concatenate([[0.0], false, elsewhere])):
        rate = ((false > score).sum() + per_survey * (elsewhere > score).sum()) / (surveys + weight)
        if rate <= alarms_per_survey:
            return float(min(score, MOST))
    return MOST


def _without_tiles(reference: Seen, current: Seen) -> Comparison:
    """Set two visits side by side for their voxels alone."""
    size = np.array([1.5, 1.5, 1.0])
    grid = TileGrid(origin=np.zeros(3), size=size, shape=(1, 1, 1))
    tiles = Tiles(grid=grid, indices=np.empty((0, 3), np.int32), points=())
    pairs = TilePairs(reference=tiles, current=(), observed=np.empty(0, bool))
    return Comparison(
        reference=Side(points=reference.points, seen=reference),
        current=Side(points=current.points, seen=current),
        tile_pairs=pairs,
    )
