"""A part of the benchmark: some visits with their maps, kept on disk, and all that there was to find in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worker.benchmarks.documents import Document, spread
from worker.benchmarks.methods import RevisitMethod
from worker.benchmarks.revisit.answers import Answers, answers_of
from worker.benchmarks.revisit.measures import Measured, measure
from worker.benchmarks.revisit.plan import RevisitSettings, VisitPlan
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
from worker.progress import Progress

VISITS = "visits"  #: folder of what is kept, within the benchmark's own


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

    def site_of(self, number: int) -> RevisitSite:
        """Return the map that a visit was made to."""
        return self.sites[self.plans[number].site.name]

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


def part_of(
    plans: tuple[VisitPlan, ...], made: RevisitSettings, out: Path, progress: Progress, *, min_voxels: int
) -> RevisitPart:
    """Make or find the visits, and list what there was to find. Raises MapFailed, and OSError for the folder."""
    place, new = make_visits(plans, made, out / VISITS, progress)
    visits = load_visits(plans, place)
    sites = {plan.site.name: load_site(plan.site, place) for plan in plans}
    return RevisitPart(
        plans=plans,
        visits=visits,
        sites=sites,
        place=place,
        tiles=tile_table(plans, visits, sites, min_points=made.pipeline.tiling.min_points),
        things=things_of(plans, visits, min_voxels=min_voxels),
        made=new,
    )


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
