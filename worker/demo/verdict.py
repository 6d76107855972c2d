"""What the service said of each tile, beside what is true."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from worker.cloud.tiling import TileGrid
from worker.simulation.truth import TileTruth


class Verdict(Enum):
    """How an answer stands to the truth; the value is what a person reads."""

    HIT = "hit"
    MISS = "missed"
    FALSE_ALARM = "false alarm"
    UNOBSERVED = "not seen well"  #: truly changed, and the service said that it cannot tell
    RIGHT = "rightly quiet"


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedTile:
    """One tile of the map."""

    tile_id: str
    center: tuple[float, float, float]  #: metres, map frame
    score: float | None
    state: str  #: as the service named it
    truth: str | None  #: what truly changed in it; None if nothing did
    verdict: Verdict


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedEdit:
    """One thing that was done between the visits."""

    sentence: str
    tiles: int  #: that it truly changed, of those in the map
    found: int  #: of these, called changed


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """The whole survey."""

    tiles: tuple[JudgedTile, ...]
    edits: tuple[JudgedEdit, ...]
    outside: int  #: truly changed tiles that the map does not keep: too few points before

    def counts(self) -> Counter[Verdict]:
        return Counter(tile.verdict for tile in self.tiles)


def grid_of(manifest: dict[str, Any]) -> TileGrid:
    """The grid of a map's tile manifest."""
    i, j, k = manifest["n_tiles_grid"]
    origin, size = (np.array(manifest[name], np.float64) for name in ("tile_origin", "tile_size"))
    return TileGrid(origin=origin, size=size, shape=(i, j, k))


def judge(
    features: Sequence[dict[str, Any]], truth: TileTruth, edits: Sequence[tuple[str, TileTruth]]
) -> Judgement:
    """Hold every feature of `/surveys/{id}/tiles` against the truth; `edits` names each edit with its own truth."""
    tiles = tuple(_judged(feature["properties"], truth, edits) for feature in features)
    kept = {tuple(feature["properties"]["tile_index"]) for feature in features}
    found = {tuple(f["properties"]["tile_index"]) for f in features if f["properties"]["state"] == "changed"}
    return Judgement(
        tiles=tiles,
        edits=tuple(
            JudgedEdit(sentence=sentence, tiles=len(own & kept), found=len(own & found))
            for sentence, own in ((sentence, _changed(each)) for sentence, each in edits)
        ),
        outside=len(_changed(truth) - kept),
    )


def _judged(tile: dict[str, Any], truth: TileTruth, edits: Sequence[tuple[str, TileTruth]]) -> JudgedTile:
    index = tuple(tile["tile_index"])
    changed = bool(truth.changed[index])
    x, y, z = tile["center"]
    return JudgedTile(
        tile_id=tile["tile_id"],
        center=(x, y, z),
        score=tile["score"],
        state=tile["state"],
        truth=_what(index, edits) if changed else None,
        verdict=_verdict(tile["state"], changed),
    )


def _verdict(state: str, changed: bool) -> Verdict:
    if state == "changed":
        return Verdict.HIT if changed else Verdict.FALSE_ALARM
    if not changed:
        return Verdict.RIGHT
    return Verdict.UNOBSERVED if state == "unobserved" else Verdict.MISS


def _what(index: tuple[int, ...], edits: Sequence[tuple[str, TileTruth]]) -> str:
    """The edit that changed most of the tile."""
    cells = [int(each.cells[index].sum()) for _, each in edits]
    return edits[int(np.argmax(cells))][0]


def _changed(truth: TileTruth) -> set[tuple[int, ...]]:
    return {tuple(index) for index in np.argwhere(truth.changed).tolist()}
