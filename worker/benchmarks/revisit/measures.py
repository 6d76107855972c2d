"""The tiles of all visits in one table, and each method's figures over it, at a threshold chosen on other visits."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.documents import Document
from worker.benchmarks.methods import Method, TileScore
from worker.benchmarks.revisit.plan import VisitPlan
from worker.benchmarks.revisit.visits import Revisit
from worker.cloud.types import Bools, Floats
from worker.metrics import Confusion, Operating, Scores, best_f1, confusion, pooled, precision_recall, roc
from worker.progress import Progress, no_progress
from worker.simulation.truth import KINDS

#: Edges of bins, in metres. Poses are off by millimetres where all goes well, by centimetres where it does not.
EDGES = (0.0, 0.0025, 0.005, 0.01, 0.02, np.inf)
RESAMPLES = 1000  #: of whole visits, for the interval of F1
INTERVAL = (2.5, 97.5)  #: percent


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TileTable:
    """N tiles, visit after visit."""

    changed: Bools  #: (N,) something changed, seen or not
    counted: Bools  #: (N,) a method can be right or wrong about it
    observed: Bools  #: (N,) the survey saw it densely enough
    slight: Bools  #: (N,) something changed, but too little for a changed tile
    kind: NDArray[np.int64]  #: (N,) index into KINDS, or NOTHING
    misalignment: Floats  #: (N,) metres, residual
    sigma: Floats  #: (N,) metres
    visit: NDArray[np.int64]  #: (N,) number of the visit
    case: NDArray[np.str_]  #: (N,)
    building: NDArray[np.str_]  #: (N,)

    def count(self, scores: Scores, threshold: float, tiles: Bools | None = None) -> Confusion:
        """Count those of the tiles (N,), or of all, that a method flagged rightly and wrongly at a threshold."""
        chosen = slice(None) if tiles is None else tiles
        return confusion(scores[chosen], self.changed[chosen], threshold, self.counted[chosen])

    def groups(self) -> dict[str, dict[str, Bools]]:
        """Return the tiles (N,) of each group, by what they are grouped by.

        Groups by kind of change hold changed tiles only; all others hold unchanged ones too.
        """
        return {
            "kind": {kind: self.kind == number for number, kind in enumerate(KINDS)},
            "case": {case: self.case == case for case in dict.fromkeys(self.case.tolist())},
            "building": {kind: self.building == kind for kind in dict.fromkeys(self.building.tolist())},
            "misfit": binned(self.misalignment),
            "sigma": binned(self.sigma),
        }


def tile_table(plans: Sequence[VisitPlan], visits: Sequence[Revisit]) -> TileTable:
    """Put the visits' tiles one after the other."""
    sizes = [len(visit.cells) for visit in visits]
    return TileTable(
        changed=np.concatenate([visit.exists for visit in visits]),
        counted=np.concatenate([visit.counted for visit in visits]),
        observed=np.concatenate([visit.pairs.observed for visit in visits]),
        slight=np.concatenate([(visit.cells.sum(axis=1) > 0) & ~visit.exists for visit in visits]),
        kind=np.concatenate([visit.kinds for visit in visits]),
        misalignment=np.concatenate([visit.misalignment for visit in visits]),
        sigma=np.concatenate([visit.sigma for visit in visits]),
        visit=np.repeat(np.arange(len(visits)), sizes),
        case=np.repeat([plan.case for plan in plans], sizes),
        building=np.repeat([plan.site.kind for plan in plans], sizes),
    )


def binned(metres: Floats) -> dict[str, Bools]:
    """Mark the values (N,) that lie in each bin, lower edge included; NaN lies in none."""
    bins = {}
    for low, high in itertools.pairwise(EDGES):
        name = f"over {100 * low:g} cm" if np.isinf(high) else f"{100 * low:g} to {100 * high:g} cm"
        bins[name] = (metres >= low) & (metres < high)
    return bins


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VisitScores:
    """What a method said of some visits."""

    scores: TileScore  #: (N,) of all tiles, visit after visit
    seconds: float  #: for all of them


def score_visits(method: Method, visits: Sequence[Revisit], progress: Progress = no_progress) -> VisitScores:
    """Score every visit by itself, against the clock."""
    scores, begun = [], time.perf_counter()
    for done, revisit in enumerate(visits):
        progress(f"scoring: {method.name}", done / len(visits))
        scores.append(method.score(revisit.pairs))
    return VisitScores(scores=np.concatenate(scores), seconds=time.perf_counter() - begun)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Measured:
    """One method. Counts are of the tiles that count; what nobody looked at stands beside them."""

    name: str
    chosen: Operating  #: threshold of the best F1 on the validation visits
    best: Operating  #: threshold of the best F1 on these very visits: what no user could have known
    stated: Operating | None  #: threshold that the method comes with
    f1_interval: tuple[float, float]  #: 95%, resampling visits, at the chosen threshold
    roc_area: float
    average_precision: float
    groups: Mapping[str, Mapping[str, Confusion]]  #: at the chosen threshold
    #: false alarms at the chosen threshold where something changed, but too little to count
    alarms_on_slight: int
    unchanged_visits: int
    unchanged_visits_with_alarm: int
    seconds: float  #: to score the test visits
    scores: Scores  #: (N,) of the table's tiles

    def document(self) -> Document:
        """Return it as JSON."""
        return {
            "name": self.name,
            "chosen": _operating(self.chosen) | {"f1_interval": list(self.f1_interval)},
            "best": _operating(self.best),
            "stated": None if self.stated is None else _operating(self.stated),
            "area_under_roc": round(self.roc_area, 4),
            "average_precision": round(self.average_precision, 4),
            "groups": {
                by: {name: counts.figures() for name, counts in groups.items()}
                for by, groups in self.groups.items()
            },
            "false_alarms_on_slight_changes": self.alarms_on_slight,
            "unchanged_visits": self.unchanged_visits,
            "unchanged_visits_with_false_alarm": self.unchanged_visits_with_alarm,
            "seconds": round(self.seconds, 2),
        }


def threshold_of(scored: VisitScores, table: TileTable) -> float:
    """Choose the cut with the best F1 over the tiles that count. Raises ValueError where none of them changed."""
    return best_f1(scored.scores[table.counted], table.changed[table.counted], None).threshold


def measure(
    name: str, scored: VisitScores, table: TileTable, *, threshold: float, stated: float | None = None
) -> Measured:
    """Compare the scores with the truth. Raises ValueError where no tile that counts has changed."""
    scores, counted = scored.scores, table.counted

    def operating(threshold: float) -> Operating:
        return Operating(threshold=threshold, counts=table.count(scores, threshold))

    flagged = (scores > threshold) & counted & ~table.changed
    quiet = table.case == "unchanged"
    return Measured(
        name=name,
        chosen=operating(threshold),
        best=operating(threshold_of(scored, table)),
        stated=None if stated is None else operating(stated),
        f1_interval=_interval(scores, table, threshold),
        roc_area=roc(scores[counted], table.changed[counted]).area,
        average_precision=precision_recall(scores[counted], table.changed[counted]).average_precision,
        groups={
            by: {group: table.count(scores, threshold, tiles) for group, tiles in groups.items()}
            for by, groups in table.groups().items()
        },
        alarms_on_slight=int((flagged & table.slight).sum()),
        unchanged_visits=len(np.unique(table.visit[quiet])),
        unchanged_visits_with_alarm=len(np.unique(table.visit[quiet & flagged])),
        seconds=scored.seconds,
        scores=scores,
    )


def _interval(scores: Scores, table: TileTable, threshold: float) -> tuple[float, float]:
    """Resample F1. Visits are what is drawn: tiles of one visit share their poses and their edits."""
    counts = [
        table.count(scores, threshold, table.visit == number) for number in range(table.visit.max() + 1)
    ]
    rng = np.random.default_rng(0)
    draws = rng.integers(len(counts), size=(RESAMPLES, len(counts)))
    resampled = [pooled(counts[number] for number in draw).f1 for draw in draws.tolist()]
    low, high = np.nanpercentile(resampled, INTERVAL)
    return round(float(low), 4), round(float(high), 4)


def _operating(point: Operating) -> Document:
    return {"threshold": point.threshold, **point.counts.figures()}
