"""Tallies: counts and sums that outlive processes and jobs, for `/metrics`.

What is worth counting happens in workers, of which each step is a process of its own; so it is counted in the database,
in the transaction of what is counted: a result that is rolled back counts for nothing.

`add` only notes. The rows are written when the transaction commits, all of them in one statement and in the order of
their keys: no two transactions wait for each other crosswise, and a row that everybody counts in is locked briefly.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import event, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.catalog.records import ScanOutcome, TileRecord
from service.catalog.sql.tables import Tally
from service.catalog.steps import STEPS, JobKind

_NOTED = "tallies"  #: where a session keeps what its transaction has counted so far


@dataclass(frozen=True, kw_only=True, slots=True)
class Measure:
    """Something that is counted (or, as a `summary`, counted and summed) under labels."""

    name: str  #: as Prometheus has it, without `_total`, `_count` and `_sum`
    help: str
    labels: tuple[str, ...]
    summary: bool = False
    #: Values of the labels that are told as 0 before anything was counted: Prometheus sees no first increase otherwise.
    expected: tuple[tuple[str, ...], ...] = ()


#: Ends of a job that somebody is called for; see docker/monitoring/alerts.yaml.
FAULTS = ("internal", "worker_died", "timed_out", "disk_full")
_OF_STEPS = tuple((kind, step.name) for kind, steps in STEPS.items() for step in steps)

STEP_SECONDS = Measure(
    name="spicd_step_seconds",
    help="Time that steps ran, by how they ended",
    labels=("kind", "step", "outcome"),
    summary=True,
)
STEP_WAIT_SECONDS = Measure(
    name="spicd_step_wait_seconds",
    help="Time that steps were due before a worker began them",
    labels=("kind", "step", "outcome"),
    summary=True,
)
ATTEMPTS = Measure(
    name="spicd_step_attempts_lost",
    help="Steps that ended without a result by their own fault",
    labels=("kind", "step"),
    expected=_OF_STEPS,
)
INTERRUPTIONS = Measure(
    name="spicd_step_interruptions",
    help="Steps that were interrupted from outside: killed, stopped, or a part that they need was away",
    labels=("kind", "step"),
    expected=_OF_STEPS,
)
JOBS_ENDED = Measure(
    name="spicd_jobs_ended",
    help="Jobs that ended: successful, or the code of their problem",
    labels=("kind", "outcome"),
    expected=tuple(itertools.product(STEPS, ("successful", *FAULTS))),
)
SCANS = Measure(
    name="spicd_scans_registered",
    help="Scans of maps and surveys by what became of them: accepted, or the reason of docs/reasons.md",
    labels=("of", "outcome"),
    expected=(("map", "accepted"), ("survey", "accepted")),
)
FITNESS = Measure(
    name="spicd_registration_fitness",
    help="Inlier fraction of accepted scans, 0 to 1",
    labels=("of",),
    summary=True,
)
RMSE = Measure(
    name="spicd_registration_rmse_metres",
    help="Root mean square over the inliers of accepted scans",
    labels=("of",),
    summary=True,
)
OBSERVED = Measure(
    name="spicd_survey_observed_share",
    help="Share of its map's tiles that a survey observed, 0 to 1",
    labels=("model",),
    summary=True,
)
TILES = Measure(
    name="spicd_survey_tiles",
    help="Tiles of a survey",
    labels=("model",),
    summary=True,
)
SWEPT = Measure(
    name="spicd_swept",
    help="Surveys, scans and folders of files that retention removed",
    labels=("what",),
)
DELIVERIES = Measure(
    name="spicd_webhook_attempts",
    help="Attempts at webhooks: delivered, refused by the receiver, or unanswered (no connection, none in time)",
    labels=("outcome",),
    expected=(("delivered",), ("refused",), ("unanswered",)),
)
NETWORK_SECONDS = Measure(
    name="spicd_inference_network_seconds",
    help="Time that batches took in the network, to their results in the worker's memory",
    labels=("model",),
    summary=True,
)
NETWORK_WAIT_SECONDS = Measure(
    name="spicd_inference_wait_seconds",
    help="Time that the first of a batch had waited for the network",
    labels=("model",),
    summary=True,
)
BATCH_SIZE = Measure(
    name="spicd_inference_batch_size",
    help="Tiles of a batch, or other items that a network takes",
    labels=("model",),
    summary=True,
)
BATCH_STEPS = Measure(
    name="spicd_inference_batch_steps",
    help="Steps, so surveys for the most part, that a batch had items of",
    labels=("model",),
    summary=True,
)
OUT_OF_MEMORY = Measure(
    name="spicd_inference_out_of_memory",
    help="Batches that did not fit into the GPU's memory and were halved",
    labels=("model",),
)
MODELS_OPENED = Measure(
    name="spicd_inference_models_opened", help="Models that an inference worker opened", labels=("model",)
)
MODELS_EVICTED = Measure(
    name="spicd_inference_models_evicted",
    help="Models that an inference worker closed, for others needed the room",
    labels=("model",),
)
#: What a worker's networks count, by the worker's name for it.
_OF_NETWORKS = {
    "network_seconds": NETWORK_SECONDS,
    "wait_seconds": NETWORK_WAIT_SECONDS,
    "batch_size": BATCH_SIZE,
    "batch_requests": BATCH_STEPS,
    "out_of_memory": OUT_OF_MEMORY,
    "models_opened": MODELS_OPENED,
    "models_evicted": MODELS_EVICTED,
}
#: By that name and the model: how often, and the sum.
InferenceCounts = Mapping[tuple[str, str], tuple[int, float]]

#: Everything that is tallied, in the order of `/metrics`.
MEASURES = (
    JOBS_ENDED,
    STEP_SECONDS,
    STEP_WAIT_SECONDS,
    ATTEMPTS,
    INTERRUPTIONS,
    SCANS,
    FITNESS,
    RMSE,
    OBSERVED,
    TILES,
    SWEPT,
    DELIVERIES,
    *_OF_NETWORKS.values(),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Sample:
    """What was counted so far under a name and labels."""

    name: str
    labels: dict[str, str]
    count: int
    total: float


def add(
    session: Session, name: str, labels: Mapping[str, str], value: float = 1.0, *, count: int = 1
) -> None:
    """Count `value`, the sum of `count`, under a name and labels, if the session's transaction commits."""
    entry = noted_in(session).setdefault((name, _text(labels)), [0, 0.0])
    entry[0] += count
    entry[1] += value


def noted_in(session: Session) -> dict[tuple[str, str], list[float]]:
    """Return what a session has noted so far, by name and labels; from now on it is written when it commits."""
    noted: dict[tuple[str, str], list[float]] | None = session.info.get(_NOTED)
    if noted is None:
        noted = session.info[_NOTED] = {}
        event.listen(session, "before_commit", _write)
    return noted


def read(session: Session) -> tuple[Sample, ...]:
    """Return everything that was counted, by name and labels."""
    rows = session.scalars(select(Tally).order_by(Tally.name, Tally.labels))
    return tuple(
        Sample(name=row.name, labels=json.loads(row.labels), count=row.count, total=row.total) for row in rows
    )


def tally_step(
    session: Session, *, kind: JobKind, step: str, outcome: str, waited_s: float, ran_s: float
) -> None:
    """Count a step that ended: `outcome` is `successful`, `interrupted`, `lost`, `put_back` or the code of a problem."""
    labels = {"kind": kind, "step": step, "outcome": outcome}
    add(session, STEP_WAIT_SECONDS.name, labels, max(waited_s, 0.0))
    add(session, STEP_SECONDS.name, labels, max(ran_s, 0.0))


def tally_attempt(session: Session, *, kind: str, step: str) -> None:
    """Count an attempt at a step that was lost by its own fault."""
    add(session, ATTEMPTS.name, {"kind": kind, "step": step})


def tally_interruption(session: Session, *, kind: str, step: str) -> None:
    """Count an interruption of a step from outside, which costs no attempt."""
    add(session, INTERRUPTIONS.name, {"kind": kind, "step": step})


def tally_job(session: Session, *, kind: str, outcome: str) -> None:
    """Count a job that ended: its status, or the code of its problem where it has one."""
    add(session, JOBS_ENDED.name, {"kind": kind, "outcome": outcome})


def tally_delivery(session: Session, answered: int | None, *, delivered: bool) -> None:
    """Count an attempt at a webhook, whose receiver `answered` with this HTTP status, or not at all."""
    outcome = "delivered" if delivered else "unanswered" if answered is None else "refused"
    add(session, DELIVERIES.name, {"outcome": outcome})


def tally_outcomes(session: Session, of: str, outcomes: Iterable[ScanOutcome], known: Iterable[str]) -> None:
    """Count what became of the scans of a `map` or `survey`, less those of which it was `known` before.

    A step may run twice, and a version of a map takes the accepted scans of its base along.
    """
    before = set(known)
    for outcome in outcomes:
        if outcome.scan_id in before or outcome.accepted is None:
            continue
        told = "accepted" if outcome.accepted else outcome.reason or "other"
        add(session, SCANS.name, {"of": of, "outcome": told})
        if outcome.accepted and outcome.fitness is not None:
            add(session, FITNESS.name, {"of": of}, outcome.fitness)
        if outcome.accepted and outcome.rmse is not None:
            add(session, RMSE.name, {"of": of}, outcome.rmse)


def tally_tiles(session: Session, model: str, tiles: Iterable[TileRecord]) -> None:
    """Count the tiles of a survey, and how much of them it observed."""
    shares = [_share(tile) for tile in tiles]
    add(session, TILES.name, {"model": model}, len(shares))
    if shares:
        add(session, OBSERVED.name, {"model": model}, sum(shares) / len(shares))


def tally_inference(session: Session, counted: InferenceCounts) -> None:
    """Count what the networks of a worker did since it last told."""
    for (figure, model), (count, total) in counted.items():
        add(session, _OF_NETWORKS[figure].name, {"model": model}, total, count=count)


def _share(tile: TileRecord) -> float:
    """Return the share observed; detectors of tiles alone tell but whether a tile was observed."""
    return float(tile.state != "unobserved") if tile.observed_share is None else tile.observed_share


def _text(labels: Mapping[str, str]) -> str:
    return json.dumps(dict(labels), sort_keys=True, separators=(",", ":"))


def _write(session: Session) -> None:
    """Add what was noted to the table: one statement, rows in order."""
    noted: dict[tuple[str, str], list[float]] = session.info[_NOTED]
    if not noted:
        return
    rows = [
        {"name": name, "labels": labels, "count": int(count), "total": total}
        for (name, labels), (count, total) in sorted(noted.items())
    ]
    noted.clear()
    of_dialect = postgresql if session.get_bind().dialect.name == "postgresql" else sqlite
    statement: Any = of_dialect.insert(Tally).values(rows)
    added = {
        "count": Tally.count + statement.excluded.count,
        "total": Tally.total + statement.excluded.total,
    }
    session.execute(statement.on_conflict_do_update(index_elements=["name", "labels"], set_=added))
