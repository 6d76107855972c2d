"""`spicd-worker evaluate real`: what models say of real visits, and what they find of things put into them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worker.benchmarks.documents import Document, names_among
from worker.benchmarks.real.answers import Answer, answer_of
from worker.benchmarks.real.edits import SIDES, EditedVisits, Side, edited, real_things
from worker.benchmarks.real.measures import Figures, PairCounts, counts_of, groups_of
from worker.benchmarks.real.pictures import draw_edited, draw_visits
from worker.benchmarks.real.visits import (
    PLACES,
    PLANS,
    Plan,
    TwoVisits,
    given_poses,
    registered_poses,
    relative,
    visits_by,
)
from worker.cloud.poses import difference
from worker.cloud.types import Matrix4
from worker.detectors.card import MODEL_STORE
from worker.detectors.detector import Detector
from worker.detectors.store import open_detector
from worker.progress import Progress, no_progress

#: Real visits that things are put into: both directions of each, and single frames as well as a map of four.
EDITED = (
    "room_scan, 1 to 2",
    "room_scan, 2 to 1",
    "corridor_pair, first to second",
    "corridor_pair, second to first",
    "kinect, 1 to 4 to 5",
    "kinect, 1 to 2",
    "ipad 808, first to second",
    "ipad 560, first to second",
)
#: Scans that real things are cut out of.
THINGS_FROM = ("room_scan, 1 to 2", "ipad 560, first to second")
_PICTURES = 8  # of edited visits


@dataclass(frozen=True, kw_only=True, slots=True)
class RealBenchmarkSettings:
    """What is run."""

    folder: Path  #: of the real scans
    models: tuple[str, ...]
    model_store: Path = MODEL_STORE
    out: Path | None = None  #: folder of the pictures
    places: tuple[str, ...] = PLACES  #: that are taken
    seeds: int = 2  #: draws of things for each visit of each pair
    registered: bool = True  #: ask again with the poses of the product's own registration


def evaluate(settings: RealBenchmarkSettings, progress: Progress = no_progress) -> Document:
    """Run all of it and draw what is to be drawn; JSON-ready.

    Raises ValueError for an unknown place, DetectorUnavailable, OSError for a missing file, ScanError for one that is none, and PipelineError.
    """
    detectors = [open_detector(settings.model_store, model) for model in settings.models]
    places = names_among(",".join(settings.places), PLACES, "place")
    plans = [plan for plan in PLANS if plan.place in places]
    poses = given_poses(settings.folder, places, progress)
    visits = {plan.name: visits_by(settings.folder, plan, poses) for plan in plans}
    answers: dict[str, list[Answer]] = {}
    for done, (name, pair) in enumerate(visits.items()):
        progress(f"as they are: {name}", done / len(visits))
        answers[name] = [answer_of(detector, pair) for detector in detectors]
        if settings.out is not None:
            draw_visits(settings.out, pair, answers[name])
    document: Document = {
        "data": {
            "files": _digest(settings.folder, plans),
            "draws": settings.seeds,
            "whole": set(places) == set(PLACES),
        },
        "models": list(settings.models),
        "pairs": [_pair(pair, answers[name]) for name, pair in visits.items()],
        "registered": _registered(settings, detectors, plans, poses, answers, progress)
        if settings.registered
        else None,
    }
    return document | {"edited": _edited(settings, detectors, visits, answers, progress)}


def _digest(folder: Path, plans: Sequence[Plan]) -> str:
    """Return the sha256 of the scans' own, in the order of their names."""
    names = sorted({name for plan in plans for name in (*plan.first, *plan.second)})
    each = (hashlib.sha256((folder / name).read_bytes()).digest() for name in names)
    return hashlib.sha256(b"".join(each)).hexdigest()


def _pair(visits: TwoVisits, answers: Sequence[Answer]) -> Document:
    return {
        "name": visits.name,
        "place": visits.place,
        "same_scans": visits.same,
        "free_space": not visits.blind,
        "scans": [
            [
                {"name": scan.name, "points": len(scan.points), "one_place": scan.sensor_origin is not None}
                for scan in visit
            ]
            for visit in (visits.first, visits.second)
        ],
        "answers": [answer.document() for answer in answers],
    }


def _registered(
    settings: RealBenchmarkSettings,
    detectors: Sequence[Detector],
    plans: Sequence[Plan],
    given: dict[str, Matrix4],
    answers: dict[str, list[Answer]],
    progress: Progress,
) -> list[Document]:
    """Ask again with the product's own poses; pairs of one map and its own scans stand where they stood."""
    rows = []
    for done, plan in enumerate(plans):
        progress(f"registered: {plan.name}", done / len(plans))
        rows.append(_registered_pair(settings, detectors, plan, given, answers[plan.name]))
    return rows


def _registered_pair(
    settings: RealBenchmarkSettings,
    detectors: Sequence[Detector],
    plan: Plan,
    given: dict[str, Matrix4],
    before: Sequence[Answer],
) -> Document:
    poses = registered_poses(settings.folder, plan)
    if isinstance(poses, str):
        return {"name": plan.name, "reason": poses}
    left_out = [name for name in (*plan.first, *plan.second) if name not in poses]
    there = Plan(
        name=plan.name,
        place=plan.place,
        first=tuple(name for name in plan.first if name in poses),
        second=plan.second,
    )
    known, found = relative(given, there), relative(poses, there)
    off = None if known is None or found is None else difference(known, found)
    asked = [
        answer_of(detector, visits_by(settings.folder, there, poses, "registered")) for detector in detectors
    ]
    return {
        "name": plan.name,
        "left_out": left_out,
        "centimetres_off": None if off is None else round(100 * off[0], 2),
        "degrees_off": None if off is None else round(float(np.degrees(off[1])), 3),
        "answers": [answer.document() for answer in asked],
        "objects_before": [None if one.objects is None else len(one.objects) for one in before],
    }


def _edited(
    settings: RealBenchmarkSettings,
    detectors: Sequence[Detector],
    visits: dict[str, TwoVisits],
    plain: dict[str, list[Answer]],
    progress: Progress,
) -> Document:
    """Put things into the visits, one visit at a time, and count what each model finds of them."""
    things = [
        thing
        for name in THINGS_FROM
        if name in visits
        for scan in (*visits[name].first, *visits[name].second)
        for thing in real_things(scan)
    ]
    counts: list[list[PairCounts]] = [[] for _ in detectors]
    plan = [
        (name, side, seed)
        for name in EDITED
        if name in visits
        for side in SIDES
        for seed in range(settings.seeds)
    ]
    pairs = []
    for done, (name, side, seed) in enumerate(plan):
        progress(f"with things put in: {name}", done / len(plan))
        pair = edited(visits[name], side, things, seed=_seed(name, side, seed))
        asked = [answer_of(detector, pair.visits) for detector in detectors]
        for row, answer in enumerate(asked):
            counts[row].append(counts_of(pair, answer, plain[name][row]))
        pairs.append(_edited_pair(pair, [column[-1] for column in counts]))
        if settings.out is not None and done % max(1, len(plan) // _PICTURES) == 0:
            draw_edited(settings.out, pair, asked[0])
    return {
        "things_cut_out": len(things),
        "pairs": pairs,
        "models": [
            {
                "model": detector.card.model,
                "sha256": detector.card.sha256,
                "fingerprint": detector.card.fingerprint,
                **Figures.of(column).document(),
                "groups": {
                    by: {name: list(numbers) for name, numbers in groups.items()}
                    for by, groups in groups_of(column).items()
                },
                "with_free_space": Figures.of([one for one in column if "ipad" not in one.place]).document(),
            }
            for detector, column in zip(detectors, counts, strict=True)
        ],
    }


def _edited_pair(pair: EditedVisits, counts: Sequence[PairCounts]) -> Document:
    return {
        "name": pair.visits.name,
        "things": [
            {"kind": region.kind, "voxels": len(region.hit), "decidable": len(region.decidable)}
            for region in pair.regions
        ],
        "found": [list(one.found) for one in counts],
        "false_objects": [one.false_of_any_size for one in counts],
        "tiles": [one.tiles.figures() for one in counts],
    }


def _seed(name: str, side: Side, seed: int) -> int:
    """Return a number that stays the same where pairs are added: by the place among EDITED."""
    return 1000 * EDITED.index(name) + 100 * (side == "second") + seed
