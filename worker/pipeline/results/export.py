"""Results for people and programs: the coloured cloud, and one row a tile."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.ply import write_ply
from worker.cloud.tiling import tile_id
from worker.cloud.types import Colors
from worker.pipeline.mapping.fusion import CurrentMap
from worker.pipeline.results.changes import ChangeSet, TileState

#: Colour-blind-safe (Okabe and Ito, 2008): grey, vermilion, reddish purple, sky blue
STATE_COLORS = {
    TileState.UNCHANGED: (170, 170, 170),
    TileState.CHANGED: (213, 94, 0),
    TileState.INCONSISTENT: (204, 121, 167),
    TileState.UNOBSERVED: (86, 180, 233),
}
NOT_IN_A_TILE = 255  #: value of `tile_state` for points outside every reference tile
_NOT_IN_A_TILE_COLOR = (225, 225, 225)


@dataclass(frozen=True, kw_only=True, slots=True)
class TileResult:
    """One tile's answer, in plain numbers; metres, map frame."""

    tile_id: str
    tile_index: tuple[int, int, int]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    state: str
    score: float | None  #: probability of change; None where unobserved
    probabilities: tuple[float, float, float] | None
    n_reference: int
    n_current: int


def tile_results(changes: ChangeSet) -> list[TileResult]:
    """Return every tile of the reference, in the grid's order."""
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    return [
        _tile_result(changes, tile, lower[tile], lower[tile] + tiles.grid.size)
        for tile in range(len(tiles.points))
    ]


def _tile_result(
    changes: ChangeSet, tile: int, lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> TileResult:
    index = changes.pairs.reference.indices[tile]
    state = TileState(int(changes.states[tile]))
    same, changed, other = (float(value) for value in changes.probabilities[tile])
    scored = state is not TileState.UNOBSERVED
    return TileResult(
        tile_id=tile_id(index),
        tile_index=(int(index[0]), int(index[1]), int(index[2])),
        lower=_rounded(lower),
        upper=_rounded(upper),
        state=state.label,
        score=float(changes.scores[tile]) if scored else None,
        probabilities=(same, changed, other) if scored else None,
        n_reference=len(changes.pairs.reference.points[tile]),
        n_current=len(changes.pairs.current[tile]),
    )


def _rounded(corner: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 6) for value in corner)
    return x, y, z


def write_coloured_cloud(path: Path, current: CurrentMap, changes: ChangeSet) -> None:
    """Write the survey's fused cloud as PLY, each point in the colour of its tile's state.

    Scalar fields: `change_score` (float; NaN where not scored) and `tile_state` (uchar; TileState, or 255
    outside every reference tile).
    """
    tiles = changes.pairs.reference
    tile = tiles.grid.locate_among(current.points, tiles.indices)
    inside = tile >= 0
    state = np.full(len(tile), NOT_IN_A_TILE, np.uint8)
    state[inside] = changes.states[tile[inside]]
    score = np.full(len(tile), np.nan, np.float32)
    score[inside] = changes.scores[tile[inside]]
    write_ply(
        path,
        current.points,
        colors=_colors(state),
        scalars={"change_score": score, "tile_state": state},
    )


def _colors(states: NDArray[np.uint8]) -> Colors:
    table = np.full((256, 3), _NOT_IN_A_TILE_COLOR, np.uint8)
    for state, color in STATE_COLORS.items():
        table[state] = color
    return table[states]
