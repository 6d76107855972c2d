"""Training tiles from simulated buildings, each walked several times (`training_walks`)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict, Field

from worker.evaluation.training_walks import Kind, WalkSettings, walked
from worker.processes import default_processes, open_processes
from worker.progress import Progress, silent
from worker.training.dataset import TileSet, joined


class TrainingSetSettings(BaseModel):
    """Which buildings are walked."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    offices: int = Field(14, ge=0, description="four rooms and a corridor each")
    corridors: int = Field(8, ge=0, description="L-shaped, about 170 tiles each")
    rooms: int = Field(50, ge=0, description="single furnished rooms")
    walks: WalkSettings = WalkSettings.model_validate({})
    seed: int = Field(1000, description="of the first building; keep test buildings apart from it")


def build_training_set(
    settings: TrainingSetSettings, progress: Progress = silent, *, processes: int | None = None
) -> TileSet:
    """Walk every building, by default as many at a time as there are cores; the same set however many."""
    tasks = [
        (number, kind, settings.seed + number, settings.walks) for number, kind in enumerate(_kinds(settings))
    ]
    found: dict[int, TileSet] = {}
    with open_processes(min(processes or default_processes(), len(tasks))) as pool:
        for number, part in pool.each(_walked, tasks):
            found[number] = part
            progress("build training set", len(found) / len(tasks))
    source = f"simulated visits: {settings.model_dump_json()}"
    return joined([found[number] for number in sorted(found)], source=source)


def _kinds(settings: TrainingSetSettings) -> Iterator[Kind]:
    counts: dict[Kind, int] = {
        "office": settings.offices,
        "corridor": settings.corridors,
        "room": settings.rooms,
    }
    for kind, count in counts.items():
        yield from itertools.repeat(kind, count)


def _walked(task: tuple[int, Kind, int, WalkSettings]) -> tuple[int, TileSet]:
    number, kind, seed, settings = task
    return number, walked(kind, seed, settings)
