"""The worst misses and all false objects of a method, as a list and with a picture each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from worker.benchmarks import plots
from worker.benchmarks.documents import Document
from worker.benchmarks.plots import FOUND, MISSED, WRONG
from worker.benchmarks.revisit.answers import Answers, PredictedObject
from worker.benchmarks.revisit.measures import Measured
from worker.benchmarks.revisit.part import RevisitPart
from worker.benchmarks.revisit.things import is_true
from worker.cloud.types import Floats
from worker.cloud.voxel_keys import Keys, centers
from worker.simulation.hits import Visit
from worker.simulation.truth import CELL

WORST = 10  #: misses of each kind
DRAWN = 80  #: pictures at most; more mistakes are listed without one
AROUND = 1.2  #: metres that a picture shows around what is in question
FOLDER = "errors"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Mistake:
    """One thing that a method got wrong."""

    what: Literal["missed object", "missed tile", "false object", "false tile"]
    visit: int  #: number of the visit
    keys: Keys  #: (n,) voxels in question; of a tile without any, its middle
    weight: float  #: by which the worst come first
    note: str


def draw_gallery(folder: Path, part: RevisitPart, measured: Measured, answers: Answers) -> list[Document]:
    """Draw the ten worst misses of tiles and of objects, all false objects, and all false tiles of quiet visits.

    Each of the first 80 is one PNG in `errors` of the folder; returns what all of them are, with the pictures' names.
    Raises OSError.
    """
    for old in (folder / FOLDER).glob("*.png"):
        old.unlink()
    documents = []
    for number, mistake in enumerate(_mistakes(part, measured, answers), start=1):
        name = f"{FOLDER}/{number:03d}-{mistake.what.replace(' ', '-')}.png"
        if number <= DRAWN:
            told = answers.visits[mistake.visit].objects or ()
            plots.save(_figure(part, mistake, told), folder / name)
        documents.append(
            {
                "what": mistake.what,
                "visit": part.plans[mistake.visit].name,
                "voxels": len(mistake.keys),
                "middle": centers(mistake.keys, CELL).mean(axis=0).round(2).tolist(),
                "note": mistake.note,
                "picture": name if number <= DRAWN else None,
            }
        )
    return documents


def _mistakes(part: RevisitPart, measured: Measured, answers: Answers) -> Iterator[Mistake]:
    yield from _worst(_missed_objects(part, measured))
    yield from _worst(_missed_tiles(part, measured))
    yield from _false_objects(part, answers)
    yield from _false_tiles(part, measured)


def _worst(mistakes: Iterator[Mistake]) -> list[Mistake]:
    return sorted(mistakes, key=lambda mistake: -mistake.weight)[:WORST]


def _missed_objects(part: RevisitPart, measured: Measured) -> Iterator[Mistake]:
    if measured.objects is None:
        return
    for row in np.flatnonzero(~measured.objects.found).tolist():
        region = part.things.regions[row]
        side = "gone" if region.side is Visit.FIRST else "come"
        count = len(region.keys)
        note = f"{region.kind}, {side}, {count} voxels, {region.size:.2f} m"
        yield Mistake(what="missed object", visit=region.visit, keys=region.keys, weight=count, note=note)


def _missed_tiles(part: RevisitPart, measured: Measured) -> Iterator[Mistake]:
    missed = part.tiles.changed & ~(measured.scores > measured.chosen.threshold)
    for row in np.flatnonzero(missed).tolist():
        cells, score = int(part.tiles.cells[row].sum()), measured.scores[row]
        told = "no score" if np.isnan(score) else f"score {score:.3g}"
        yield Mistake(
            what="missed tile",
            visit=int(part.tiles.visit[row]),
            keys=_keys_in_tile(row, part),
            weight=cells,
            note=f"{cells} changed voxels, {told}",
        )


def _false_objects(part: RevisitPart, answers: Answers) -> Iterator[Mistake]:
    for number, answer in enumerate(answers.visits):
        for thing in answer.objects or ():
            if not is_true(thing, part.visits[number]):
                count = len(thing.keys)
                note = f"{thing.kind}, {count} voxels, P {thing.probability:.2f}"
                yield Mistake(what="false object", visit=number, keys=thing.keys, weight=count, note=note)


def _false_tiles(part: RevisitPart, measured: Measured) -> Iterator[Mistake]:
    table = part.tiles
    flagged = (measured.scores > measured.chosen.threshold) & table.counted & ~table.changed & table.quiet
    for row in np.flatnonzero(flagged).tolist():
        score = float(measured.scores[row])
        yield Mistake(
            what="false tile",
            visit=int(table.visit[row]),
            keys=_keys_in_tile(row, part),
            weight=score,
            note=f"score {score:.3g}",
        )


def _keys_in_tile(row: int, part: RevisitPart) -> Keys:
    """Return the decidable changed voxels in a tile, or where it has none, what either visit hit there."""
    number = int(part.tiles.visit[row])
    site, revisit = part.site_of(number), part.visits[number]
    first = int(np.flatnonzero(part.tiles.visit == number)[0])
    grid, tile = site.reference.grid, revisit.tiles[row - first]

    def inside(keys: Keys) -> Keys:
        places = np.floor((centers(keys, CELL) - grid.origin) / grid.size)
        return keys[np.all(places == tile, axis=1)]

    changed = inside(revisit.truth.decidable_keys())
    return changed if len(changed) else np.union1d(inside(site.seen.keys), inside(revisit.seen.keys))


def _figure(part: RevisitPart, mistake: Mistake, told: Sequence[PredictedObject]) -> Figure:
    """Draw the place from above and from the side: the map grey, the survey blue, truth green, what was told red."""
    site, revisit = part.site_of(mistake.visit), part.visits[mistake.visit]
    places = centers(mistake.keys, CELL)
    low, high = places.min(axis=0) - AROUND, places.max(axis=0) + AROUND
    figure = Figure(figsize=(10, 5), dpi=90, layout="constrained")
    keys = [thing.keys for thing in told]
    layers: list[tuple[str, str, Floats]] = [
        ("map", "#9e9e9e", centers(site.seen.keys, CELL)),
        ("survey", "#90caf9", centers(revisit.seen.keys, CELL)),
        ("truth", FOUND, centers(revisit.truth.decidable_keys(), CELL)),
        ("told", WRONG, centers(np.concatenate([*keys, np.empty(0, np.int64)]), CELL)),
        ("in question", MISSED, places),
    ]
    for axes, across, side in zip(
        figure.subplots(1, 2), ((0, 1), (0, 2)), ("above", "the side"), strict=True
    ):
        for name, color, points in layers:
            _scatter(axes, points, (low, high), across, name, color)
        axes.set_aspect("equal")
        axes.set_xlim(low[across[0]], high[across[0]])
        axes.set_ylim(low[across[1]], high[across[1]])
        across_names = ["xyz"[axis] for axis in across]
        plots.label(axes, f"seen from {side}: {across_names[0]} (m)", f"{across_names[1]} (m)", legend=False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    title = f"{mistake.what}, {part.plans[mistake.visit].name}: {mistake.note}"
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    return figure


def _scatter(
    axes: Axes, points: Floats, box: tuple[Floats, Floats], across: tuple[int, int], name: str, color: str
) -> None:
    inside = points[np.all((points > box[0]) & (points < box[1]), axis=1)]
    hollow = name == "in question"
    axes.scatter(
        inside[:, across[0]],
        inside[:, across[1]],
        s=14 if hollow else 3,
        facecolors="none" if hollow else color,
        edgecolors=color if hollow else "none",
        linewidths=0.5,
        alpha=0.7,
        label=name,
    )
