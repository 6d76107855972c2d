"""What the service said of each object beside what was done: found, told as something else, missed, or made up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from worker.cloud.types import Floats
from worker.simulation.scenes import Change
from worker.simulation.scenes.scene import ChangeKind
from worker.simulation.truth import MIN_CELLS

NEAR = 0.3  #: metres from the box of what was put, taken or moved to the centre of what was told
_TOLD_AS: dict[ChangeKind, str] = {"add": "appeared", "remove": "disappeared", "move": "moved"}


class Find(Enum):
    """How what was told of an edit stands to it; the value is what a person reads."""

    FOUND = "found"
    OTHERWISE = "found, told otherwise"  #: by an object of another kind, or in pieces
    UNSEEN = "out of the robot's sight"  #: and not told
    MISSED = "missed"


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedThing:
    """One thing that was done between the visits."""

    sentence: str
    find: Find
    told: tuple[dict[str, Any], ...]  #: properties of the objects that tell it


@dataclass(frozen=True, kw_only=True, slots=True)
class ThingsJudgement:
    """All that was done, and what was told without anything done."""

    things: tuple[JudgedThing, ...]
    made_up: tuple[dict[str, Any], ...]  #: properties of objects

    def count(self, *finds: Find) -> int:
        return sum(thing.find in finds for thing in self.things)


def judge_things(
    features: Sequence[dict[str, Any]], edits: Sequence[tuple[str, Change, int]]
) -> ThingsJudgement:
    """Hold every feature of `/surveys/{id}/objects` against the edits, whose boxes are in the map frame.

    An edit is its sentence, its boxes, and how many cells of it the robot could see.
    """
    objects = [feature["properties"] for feature in features]
    told: list[list[dict[str, Any]]] = [[] for _ in edits]
    made_up = []
    for thing in objects:
        near = [row for row, (_, change, _) in enumerate(edits) if _tells(thing, change)]
        for row in near:
            told[row].append(thing)
        if not near:
            made_up.append(thing)
    things = [
        JudgedThing(sentence=sentence, find=_find(change, of_edit, cells), told=tuple(of_edit))
        for (sentence, change, cells), of_edit in zip(edits, told, strict=True)
    ]
    return ThingsJudgement(things=tuple(things), made_up=tuple(made_up))


def _find(change: Change, told: Sequence[dict[str, Any]], cells: int) -> Find:
    if not told:
        return Find.UNSEEN if cells < MIN_CELLS else Find.MISSED
    whole = any(thing["kind"] == _TOLD_AS[change.kind] for thing in told)
    return Find.FOUND if whole else Find.OTHERWISE


def _tells(thing: dict[str, Any], change: Change) -> bool:
    """Tell whether an object lies where something was put, taken away, or moved from or to."""
    places = ((thing["now"], change.after), (thing["before"], change.before))
    return any(
        place is not None and box is not None and _gap(np.array(place["center"]), box) <= NEAR
        for place, box in places
    )


def _gap(point: Floats, box: Floats) -> float:
    """Return the distance of a point (3,) to a box (2, 3); 0 within."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(box[0] - point, point - box[1]))))


_STYLE = {Find.FOUND: "green", Find.OTHERWISE: "yellow", Find.UNSEEN: "blue", Find.MISSED: "bold red"}


def show_things(console: Console, judgement: ThingsJudgement, *, moving: int) -> None:
    """Show what was done beside what was told, and what was made up."""
    table = Table("what was done between the visits", "the service says", "")
    for thing in judgement.things:
        said = "; ".join(sentence_of(one) for one in thing.told) or "nothing"
        table.add_row(thing.sentence, said, Text(thing.find.value, _STYLE[thing.find]))
    for one in judgement.made_up:
        table.add_row("nothing", sentence_of(one), Text("false alarm", "yellow"))
    console.print(table)
    console.print(_counts(judgement, moving), highlight=False)


def sentence_of(thing: dict[str, Any]) -> str:
    """Tell an object in words: `2 appeared: 0.8 x 0.5 x 0.8 m at (7.58, 4.39)`."""
    place = thing["now"] or thing["before"]
    x, y, _ = place["center"]
    size = " x ".join(f"{edge:.1f}" for edge in place["size"])
    return f"{thing['number']} {thing['kind']}{_way(thing['motion'])}: {size} m at ({x:.2f}, {y:.2f})"


def _way(motion: dict[str, Any] | None) -> str:
    if motion is None:
        return ""
    way = f" by {math.hypot(*motion['translation']):.1f} m"
    yaw = motion["yaw_degrees"]
    return way if yaw is None else f"{way}, turned by {abs(yaw):.0f}°"


def _counts(judgement: ThingsJudgement, moving: int) -> str:
    found, done = judgement.count(Find.FOUND, Find.OTHERWISE), len(judgement.things)
    unseen = judgement.count(Find.UNSEEN)
    lines = [f"{found} of {done} changes found, {len(judgement.made_up)} false alarms"]
    if unseen:
        lines.append(f"{unseen} could not be seen by the robot")
    if moving:
        lines.append(f"{moving} things moved while the robot looked: counted, and no objects")
    return "\n".join(lines)
