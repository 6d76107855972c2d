"""The figures of one method over all test visits, its threshold chosen on other visits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from worker.benchmarks.revisit.methods import Scored
from worker.benchmarks.revisit.tile_table import TileTable
from worker.cloud.types import Bools
from worker.metrics import Confusion, Operating, Scores, best_f1, confusion, pooled, precision_recall, roc

RESAMPLES = 1000  #: of whole visits, for the interval of F1
INTERVAL = (2.5, 97.5)  #: percent


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
    alarms_on_slight: (
        int  #: false alarms at the chosen threshold where something changed, but too little to count
    )
    unchanged_visits: int
    unchanged_visits_with_alarm: int
    seconds: float  #: to score the test visits
    scores: Scores  #: (N,) of the table's tiles

    def document(self) -> dict[str, Any]:
        """JSON-ready."""
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


def threshold_of(scored: Scored, table: TileTable) -> float:
    """The cut with the best F1 over the tiles that count. Raises ValueError where none of them changed."""
    return best_f1(scored.together[table.counted], table.changed[table.counted], None).threshold


def measure(
    name: str, scored: Scored, table: TileTable, *, threshold: float, stated: float | None = None
) -> Measured:
    """Hold the scores against the truth. Raises ValueError where no tile that counts has changed."""
    scores, counted = scored.together, table.counted
    count = Counter(scores=scores, table=table, threshold=threshold)
    flagged = (scores > threshold) & counted & ~table.changed
    quiet = table.case == "unchanged"
    return Measured(
        name=name,
        chosen=Operating(threshold=threshold, counts=count.within()),
        best=_everywhere(best_f1(scores[counted], table.changed[counted], None).threshold, scores, table),
        stated=None if stated is None else _everywhere(stated, scores, table),
        f1_interval=_interval(count),
        roc_area=roc(scores[counted], table.changed[counted]).area,
        average_precision=precision_recall(scores[counted], table.changed[counted]).average_precision,
        groups={
            by: {group: count.within(tiles) for group, tiles in groups.items()}
            for by, groups in table.groups().items()
        },
        alarms_on_slight=int((flagged & table.slight).sum()),
        unchanged_visits=len(np.unique(table.visit[quiet])),
        unchanged_visits_with_alarm=len(np.unique(table.visit[quiet & flagged])),
        seconds=scored.seconds,
        scores=scores,
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Counter:
    """Counts of parts of a table at one threshold."""

    scores: Scores  #: (N,)
    table: TileTable
    threshold: float

    def within(self, tiles: Bools | None = None) -> Confusion:
        """Of some of the tiles (N,), or of all."""
        at = slice(None) if tiles is None else tiles
        table = self.table
        return confusion(self.scores[at], table.changed[at], self.threshold, table.counted[at])


def _everywhere(threshold: float, scores: Scores, table: TileTable) -> Operating:
    counts = Counter(scores=scores, table=table, threshold=threshold).within()
    return Operating(threshold=threshold, counts=counts)


def _interval(count: Counter) -> tuple[float, float]:
    """Visits are what is drawn: tiles of one visit share their poses and their edits."""
    visits = count.table.visit
    each = [count.within(visits == number) for number in range(visits.max() + 1)]
    rng = np.random.default_rng(0)
    draws = rng.integers(len(each), size=(RESAMPLES, len(each)))
    found = [pooled(each[number] for number in draw).f1 for draw in draws.tolist()]
    low, high = np.nanpercentile(found, INTERVAL)
    return round(float(low), 4), round(float(high), 4)


def _operating(point: Operating) -> dict[str, Any]:
    return {"threshold": point.threshold, **point.counts.figures()}
