"""`spicd-worker evaluate revisit`: visits made or found, every method asked, thresholds chosen, figures taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from worker.benchmarks.documents import Document, spread
from worker.benchmarks.methods import RevisitMethod, revisit_methods
from worker.benchmarks.revisit.answers import Answers, answers_of
from worker.benchmarks.revisit.gallery import draw_gallery
from worker.benchmarks.revisit.measures import Measured, measure, scores_of, threshold_of
from worker.benchmarks.revisit.plan import (
    HARD_SEED,
    TEST_SEED,
    VALIDATION_SEED,
    RevisitSettings,
    VisitPlan,
    plan_hard_visits,
    plan_visits,
)
from worker.benchmarks.revisit.report import draw
from worker.benchmarks.revisit.things import Things, things_of
from worker.benchmarks.revisit.tiles import TileTable, tile_table
from worker.benchmarks.revisit.visits import (
    Revisit,
    RevisitSite,
    VisitPoses,
    load_site,
    load_visits,
    make_visits,
)
from worker.benchmarks.trajectory import WRONG
from worker.cloud.types import Floats
from worker.detectors.card import MODEL_STORE
from worker.progress import Progress, no_progress

VISITS = "visits"  #: folder of what is kept, within the benchmark's own


@dataclass(frozen=True, kw_only=True, slots=True)
class RevisitBenchmarkSettings:
    """What is run."""

    out: Path  #: folder of the visits, which are kept, and of the pictures
    visits: int = 48
    validation: int = 48  #: visits that thresholds are chosen on
    hard: bool = True  #: also the hard part
    model: str = "spicd-net/1"
    model_store: Path = MODEL_STORE
    weights: tuple[Path, ...] = ()  #: checkpoints, measured instead of the model's own weights
    others: bool = True  #: also the other models of the store, and the baselines
    made: RevisitSettings = field(default_factory=RevisitSettings)
    pictures: bool = True


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RevisitPart:
    """Some visits, and all that there was to find in them."""

    plans: tuple[VisitPlan, ...]
    visits: tuple[Revisit, ...]
    sites: Mapping[str, RevisitSite]
    place: Path  #: where they are kept
    tiles: TileTable
    things: Things
    made: int  #: how many of them had to be made

    def asked(self, method: RevisitMethod, made: RevisitSettings, progress: Progress) -> Answers:
        """Ask a method of every visit."""
        return answers_of(method, self.plans, self.visits, self.place, made.pipeline, progress)

    def measured(self, method: RevisitMethod, answers: Answers, threshold: float) -> Measured:
        """Compare its answers with the truth."""
        return measure(
            method.name,
            answers,
            self.tiles,
            self.things,
            self.visits,
            threshold=threshold,
            stated=method.stated,
        )


def evaluate(settings: RevisitBenchmarkSettings, progress: Progress = no_progress) -> Document:
    """Run all of it, and draw what is to be drawn; JSON-ready.

    Raises DetectorUnavailable, MapFailed, OSError for the folder, and ValueError where too few visits are asked for to
    have a changed tile among them.
    """
    made = settings.made
    methods, left_out = revisit_methods(
        settings.model_store, settings.model, settings.weights, made.pipeline, others=settings.others
    )
    parts = visited(settings, progress)
    document: Document = {
        "settings": made.model_dump(mode="json"),
        "seeds": {"test": TEST_SEED, "validation": VALIDATION_SEED, "hard": HARD_SEED},
        "made": sum(part.made for part in parts.values()),
        **{name: summary(part) for name, part in parts.items()},
        "left_out": left_out,
        "methods": [],
    }
    measured: dict[str, list[Measured]] = {name: [] for name in parts}
    for number, method in enumerate(methods):
        threshold = threshold_of(
            scores_of(parts["validation"].asked(method, made, progress)), parts["validation"].tiles
        )
        row: Document = {"name": method.name, "sha256": method.sha256}
        for name in ("test", "hard"):
            if name in parts:
                answers = parts[name].asked(method, made, progress)
                measured[name].append(parts[name].measured(method, answers, threshold))
                figures = measured[name][-1].document(parts[name].things)
                row |= figures if name == "test" else {"hard": figures}
                if settings.pictures and number == 0:
                    progress("drawing", 0.0)
                    row |= {
                        f"{name}_errors": _gallery(
                            settings.out / name, parts[name], measured[name][0], answers
                        )
                    }
        document["methods"].append(row)
    if settings.pictures:
        draw(settings.out, measured["test"], parts["test"].tiles)
    return document


def visited(settings: RevisitBenchmarkSettings, progress: Progress = no_progress) -> dict[str, RevisitPart]:
    """Make or find the visits of `test`, `validation` and `hard`. Raises as `evaluate` does."""
    plans = {
        "test": plan_visits(settings.visits, settings.made, first_seed=TEST_SEED),
        "validation": plan_visits(settings.validation, settings.made, first_seed=VALIDATION_SEED),
        "hard": plan_hard_visits(settings.made) if settings.hard else (),
    }
    parts = {
        name: _part(chosen, settings.made, settings.out, progress) for name, chosen in plans.items() if chosen
    }
    _check(parts["test"].tiles, "--visits")
    _check(parts["validation"].tiles, "--validation")
    if "hard" in parts and not parts["hard"].tiles.changed.any():
        del parts["hard"]
    return parts


def summary(part: RevisitPart) -> Document:
    """Say what there was to find."""
    tiles, things = part.tiles, part.things
    return {
        "visits": len(part.visits),
        "without_change": sum(things.quiet),
        "tiles": len(tiles.changed),
        "changed": int(tiles.changed.sum()),
        "changed_and_thin_in_the_map": int((tiles.changed & ~tiles.dense).sum()),
        "unchanged": int((tiles.counted & ~tiles.changed).sum()),
        "left_out": int((~tiles.counted).sum()),
        "regions": len(things.regions),
        "moved": len(things.moved),
        "misfit_centimetres": _centimetres(tiles.misalignment),
        "scans": {
            "first": _scans([site.poses for site in part.sites.values()]),
            "second": _scans([visit.poses for visit in part.visits]),
        },
        "by_visit": [_visit(number, visit, tiles) for number, visit in enumerate(part.visits)],
    }


def _part(plans: tuple[VisitPlan, ...], made: RevisitSettings, out: Path, progress: Progress) -> RevisitPart:
    place, new = make_visits(plans, made, out / VISITS, progress)
    visits = load_visits(plans, place)
    sites = {plan.site.name: load_site(plan.site, place) for plan in plans}
    return RevisitPart(
        plans=plans,
        visits=visits,
        sites=sites,
        place=place,
        tiles=tile_table(plans, visits, sites, min_points=made.pipeline.tiling.min_points),
        things=things_of(plans, visits),
        made=new,
    )


def _gallery(folder: Path, part: RevisitPart, measured: Measured, answers: Answers) -> list[Document]:
    return draw_gallery(
        folder, part.plans, part.visits, part.sites, part.tiles, part.things, measured, answers
    )


def _check(table: TileTable, option: str) -> None:
    if not table.changed.any():
        raise ValueError(f"no changed tile was seen in these visits; ask for more with {option}")


def _visit(number: int, visit: Revisit, table: TileTable) -> Document:
    own = table.visit == number
    return {
        "name": visit.name,
        "tiles": int(own.sum()),
        "changed": int((own & table.changed).sum()),
        "left_out": int((own & ~table.counted).sum()),
        "edits": len(visit.truth.things),
        "accepted": int(visit.poses.accepted.sum()),
        "scans": len(visit.poses.accepted),
        "misfit_centimetres": _centimetres(visit.misalignment),
    }


def _scans(poses: Sequence[VisitPoses]) -> Document:
    """Summarize the scans of all visits."""
    metres = np.concatenate([visit.metres for visit in poses])
    sigmas = np.concatenate([visit.sigmas[:, 0] for visit in poses])
    stated = sigmas > 0
    return {
        "accepted": len(metres),
        "of": sum(len(visit.accepted) for visit in poses),
        "wrong": int((metres > WRONG).sum()),
        "centimetres": _centimetres(metres),
        "within_2_sigma": float(np.mean(metres[stated] <= 2 * sigmas[stated])) if stated.any() else None,
    }


def _centimetres(metres: Floats) -> Document | None:
    return spread(100 * metres, "median", "95%", "worst", digits=3)
