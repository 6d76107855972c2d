"""Each method's figures over the visits: tiles at a threshold chosen on other visits, objects, and calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.benchmarks.revisit.answers import Answers
from worker.benchmarks.revisit.calibration import Reliability
from worker.benchmarks.revisit.things import ObjectFigures, Things, object_figures
from worker.benchmarks.revisit.tiles import TileTable
from worker.benchmarks.revisit.visits import Revisit
from worker.cloud.types import Floats
from worker.metrics import Confusion, Operating, Scores, best_f1, pooled, precision_recall, roc

RESAMPLES = 1000  #: of whole visits, for intervals
INTERVAL = (2.5, 97.5)  #: percent


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Measured:
    """One method. Counts are of the tiles that count: truly changed and decidable ones, and those without any change."""

    name: str
    chosen: Operating  #: threshold of the best F1 on the validation visits
    best: Operating  #: threshold of the best F1 on these very visits: what no user could have known
    stated: Operating | None  #: threshold that the method comes with
    f1_interval: tuple[float, float]  #: 95%, resampling visits, at the chosen threshold
    roc_area: float
    average_precision: float
    groups: Mapping[str, Mapping[str, Confusion]]  #: at the chosen threshold
    untold: int  #: truly changed tiles that it has no score for; misses, too
    quiet_visits: int
    quiet_visits_with_tile: int  #: with a tile flagged at the chosen threshold
    quiet_visits_alarmed: int  #: with a tile flagged, or an object
    objects: ObjectFigures | None
    tile_reliability: Reliability | None  #: None for scores that are no probabilities
    voxel_reliability: Reliability | None
    limits: tuple[float, ...]  #: least score of an object, by each map's own scans
    seconds: float  #: to answer the test visits
    scores: Scores  #: (N,) of the table's tiles

    def document(self, things: Things) -> Document:
        """Return it as JSON."""
        return {
            "name": self.name,
            "chosen": _operating(self.chosen) | {"f1_interval": list(self.f1_interval)},
            "best": _operating(self.best),
            "stated": None if self.stated is None else _operating(self.stated),
            "area_under_roc": round(self.roc_area, 4),
            "average_precision": round(self.average_precision, 4),
            "changed_without_score": self.untold,
            "quiet_visits": self.quiet_visits,
            "quiet_visits_with_false_tile": self.quiet_visits_with_tile,
            "quiet_visits_with_false_alarm": self.quiet_visits_alarmed,
            "groups": {
                by: {name: counts.figures() for name, counts in groups.items()}
                for by, groups in self.groups.items()
            },
            "objects": None if self.objects is None else self._objects(things),
            "calibration": {
                "tiles": None if self.tile_reliability is None else self.tile_reliability.document(),
                "voxels": None if self.voxel_reliability is None else self.voxel_reliability.document(),
            },
            "seconds": round(self.seconds, 2),
        }

    def _objects(self, things: Things) -> Document | None:
        figures = self.objects
        if figures is None:
            return None
        of_visit = np.array([region.visit for region in things.regions], np.int64)
        count = len(things.case)
        return {
            **figures.document(things),
            "least_scores": [round(limit, 2) for limit in self.limits],
            "recall_interval": _share_interval(figures.found, of_visit, count),
            "precision_interval": _share_interval(figures.true, figures.of_visit, count),
        }


def threshold_of(scores: Scores, table: TileTable) -> float:
    """Choose the cut with the best F1 over the tiles that count. Raises ValueError where none of them changed."""
    return best_f1(scores[table.counted], table.changed[table.counted], None).threshold


def scores_of(answers: Answers) -> Floats:
    """Put the scores of all visits one after the other: (N,)"""
    return np.concatenate([answer.scores for answer in answers.visits])


def measure(
    name: str,
    answers: Answers,
    table: TileTable,
    things: Things,
    visits: Sequence[Revisit],
    *,
    threshold: float,
    stated: float | None = None,
) -> Measured:
    """Compare the answers with the truth. Raises ValueError where no tile that counts has changed."""
    scores, counted = scores_of(answers), table.counted

    def operating(threshold: float) -> Operating:
        return Operating(threshold=threshold, counts=table.count(scores, threshold))

    flagged = (scores > threshold) & counted & ~table.changed & table.quiet
    tile_alarms = set(np.unique(table.visit[flagged]).tolist())
    quiet = set(np.flatnonzero(things.quiet).tolist())
    object_alarms = {number for number in quiet if answers.visits[number].objects}
    return Measured(
        name=name,
        chosen=operating(threshold),
        best=operating(threshold_of(scores, table)),
        stated=None if stated is None else operating(stated),
        f1_interval=_f1_interval(scores, table, threshold),
        roc_area=roc(scores[counted], table.changed[counted]).area,
        average_precision=precision_recall(scores[counted], table.changed[counted]).average_precision,
        groups={
            by: {group: table.count(scores, threshold, tiles) for group, tiles in groups.items()}
            for by, groups in table.groups().items()
        },
        untold=int((np.isnan(scores) & table.changed).sum()),
        quiet_visits=len(quiet),
        quiet_visits_with_tile=len(tile_alarms),
        quiet_visits_alarmed=len(tile_alarms | object_alarms),
        objects=object_figures(things, visits, answers.visits),
        tile_reliability=None if stated is None else _tile_reliability(scores, table),
        voxel_reliability=Reliability.pooled(answer.reliability for answer in answers.visits),
        limits=answers.limits,
        seconds=answers.seconds,
        scores=scores,
    )


def _tile_reliability(scores: Scores, table: TileTable) -> Reliability:
    told = table.counted & ~np.isnan(scores)
    return Reliability.of(np.clip(scores[told], 0, 1), table.changed[told])


def _f1_interval(scores: Scores, table: TileTable, threshold: float) -> tuple[float, float]:
    """Resample F1. Visits are what is drawn: tiles of one visit share their poses and their edits."""
    counts = [
        table.count(scores, threshold, table.visit == number) for number in range(table.visit.max() + 1)
    ]
    return _interval(len(counts), lambda draw: pooled(counts[number] for number in draw.tolist()).f1)


def _share_interval(yes: NDArray[np.bool_], of_visit: NDArray[np.int64], visits: int) -> list[float] | None:
    """Resample the share that is true of what each visit has; None where there is nothing."""
    if not len(yes):
        return None
    whole = np.bincount(of_visit, minlength=visits)
    part = np.bincount(of_visit[yes], minlength=visits)
    with np.errstate(invalid="ignore"):
        return [*_interval(visits, lambda draw: float(part[draw].sum() / np.float64(whole[draw].sum())))]


def _interval(visits: int, figure: Callable[[NDArray[np.int64]], float]) -> tuple[float, float]:
    draws = np.random.default_rng(0).integers(visits, size=(RESAMPLES, visits))
    low, high = np.nanpercentile([figure(draw) for draw in draws], INTERVAL)
    return round(float(low), 4), round(float(high), 4)


def _operating(point: Operating) -> Document:
    return {"threshold": point.threshold, **point.counts.figures()}
