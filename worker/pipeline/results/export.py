"""Results for programs: one row a tile, and the coloured cloud."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.laz import write_laz
from worker.cloud.formats.ply import SCALAR, write_ply
from worker.cloud.tiling import tile_id
from worker.cloud.types import Bools, Colors, Points
from worker.cloud.voxel_keys import rows_of
from worker.cloud.voxels import Voxels
from worker.detectors.detector import VoxelScores
from worker.pipeline.results.changes import ChangeSet, TileState
from worker.pipeline.results.objects import ChangeObjects

#: Colour-blind-safe (Okabe and Ito, 2008): grey, vermilion, reddish purple, sky blue
STATE_COLORS = {
    TileState.UNCHANGED: (170, 170, 170),
    TileState.CHANGED: (213, 94, 0),
    TileState.INCONSISTENT: (204, 121, 167),
    TileState.UNOBSERVED: (86, 180, 233),
}
NOT_IN_A_TILE = 255  #: value of `tile_state` for points outside every reference tile
_NOT_IN_A_TILE_COLOR = (225, 225, 225)


class PointKind(IntEnum):
    """What is said of one point; the numbers stand in the coloured cloud."""

    UNCHANGED = 0  #: the other visit has it too, or what is missing is too little to be an object
    APPEARED = 1  #: of an object that came, or of the present place of one that was moved
    DISAPPEARED = 2  #: of the map: of an object that went, or of the former place of one that was moved
    NOT_JUDGED = 3  #: the map's scans could not see whether it was there
    MOVING = 4  #: it moved while the visit lasted: people, doors


#: Of the same palette, with the lightest grey where nothing can be said.
KIND_COLORS = {
    PointKind.UNCHANGED: (150, 150, 150),
    PointKind.APPEARED: (213, 94, 0),
    PointKind.DISAPPEARED: (0, 114, 178),
    PointKind.NOT_JUDGED: (215, 215, 215),
    PointKind.MOVING: (240, 228, 66),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class TileResult:
    """One tile's answer, in plain numbers; metres, map frame."""

    tile_id: str
    tile_index: tuple[int, int, int]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    state: str
    score: float | None  #: probability of change; None where nothing could be compared
    probabilities: tuple[float, float, float] | None  #: likewise
    n_reference: int
    n_current: int
    observed_share: float | None  #: that the survey could judge; None: the detector scores tiles alone
    appeared: int | None  #: voxels; None as above
    disappeared: int | None  #: likewise


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
    scored = not np.isnan(changes.scores[tile])
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
        observed_share=None if changes.observed_share is None else float(changes.observed_share[tile]),
        appeared=None if changes.appeared is None else int(changes.appeared[tile]),
        disappeared=None if changes.disappeared is None else int(changes.disappeared[tile]),
    )


def _rounded(corner: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 6) for value in corner)
    return x, y, z


@dataclass(frozen=True, kw_only=True, slots=True)
class ColouredCloud:
    """The survey's fused cloud with what was found of each point; with objects also what the map lost. Map frame."""

    points: Points  #: (N, 3) float32, metres
    colors: Colors  #: (N, 3) uint8
    scalars: Mapping[str, NDArray[Any]]  #: (N,) each, by name

    @classmethod
    def of(cls, reference: Points, current: Points, changes: ChangeSet) -> Self:
        """Colour the survey's cloud (N, 3) and, where there are objects, the points of the map (M, 3) that are lost.

        Scalars: `change_score` (float; NaN where not scored) and `tile_state` (uint8; TileState, or 255 outside every
        tile). A detector of tiles alone colours each point by its tile's state. Where there are objects the score is
        the point's own, each point is coloured by its `kind` (uint8; PointKind), and `object_id` (int) is the number of
        its object, 0 where it is of none.
        """
        if changes.voxels is None or changes.objects is None:
            state, score = _of_tiles(current, changes)
            scalars: dict[str, NDArray[Any]] = {"change_score": score, "tile_state": state}
            return cls(points=current, colors=_colors(STATE_COLORS)[state], scalars=scalars)
        told = [
            _survey_points(current, changes.voxels, changes.objects),
            _lost_points(reference, changes.voxels, changes.objects),
        ]
        points = np.concatenate([points for points, _, _, _ in told])
        kind = np.concatenate([kind for _, kind, _, _ in told])
        score = np.concatenate([score for _, _, score, _ in told])
        number = np.concatenate([number for _, _, _, number in told])
        state, _ = _of_tiles(points, changes)
        scalars = {"change_score": score, "tile_state": state, "kind": kind, "object_id": number}
        return cls(points=points, colors=_colors(KIND_COLORS)[kind], scalars=scalars)

    def write_ply(self, path: Path) -> None:
        """Write it as PLY: each scalar with `scalar_` before its name, told of in the header.

        `change_score` is there as `quality` too, for MeshLab.
        """
        write_ply(
            path,
            self.points,
            colors=self.colors,
            scalars=self.scalars,
            quality=self.scalars["change_score"],
            comments=_legend(self.scalars),
        )

    def write_laz(self, path: Path) -> None:
        """Write it as LAZ: each scalar as extra bytes, colours of 16 bits."""
        write_laz(path, self.points, colors=self.colors, scalars=self.scalars, meanings=_IN_SHORT)


def write_coloured_cloud(path: Path, reference: Points, current: Points, changes: ChangeSet) -> None:
    """Write the survey's fused cloud (N, 3), map frame, as coloured PLY; with objects also what the map (M, 3) lost."""
    ColouredCloud.of(reference, current, changes).write_ply(path)


#: What a scalar is, in the 31 letters that a LAS has for it; architecture.md has the numbers.
_IN_SHORT = {
    "change_score": "probability, NaN: not scored",
    "tile_state": "0 same 1 changed 2 odd 3 unseen",
    "kind": "0 same 1 new 2 gone 3 ? 4 moved",
    "object_id": "number of the object, 0: none",
}


def _legend(names: Collection[str]) -> list[str]:
    """Return what the values of these scalar fields mean, a line each."""
    states = ", ".join(f"{state.value} {state.label}" for state in TileState)
    kinds = ", ".join(f"{kind.value} {kind.name.lower().replace('_', ' ')}" for kind in PointKind)
    meanings = {
        "change_score": "probability of change 0..1, NaN where nothing could be compared",
        "tile_state": f"{states}, {NOT_IN_A_TILE} outside every tile",
        "kind": kinds,
        "object_id": "number of the object in its survey, 0 none",
    }
    frame = f"SPICD: metres, map frame, z up; colours by {'kind' if 'kind' in names else 'tile_state'}"
    return [
        frame,
        *(f"{SCALAR}{name}: {meanings[name]}" for name in names),
        "quality: as scalar_change_score",
    ]


def _of_tiles(points: Points, changes: ChangeSet) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return state and score of the tile that each point (N, 3) lies in, (N,) each."""
    tiles = changes.pairs.reference
    tile = tiles.grid.locate_among(points, tiles.indices)
    inside = tile >= 0
    state = np.full(len(tile), NOT_IN_A_TILE, np.uint8)
    state[inside] = changes.states[tile[inside]]
    score = np.full(len(tile), np.nan, np.float32)
    score[inside] = changes.scores[tile[inside]]
    return state, score


#: Points (N, 3), and of each its kind, its score and the number of its object, (N,) each.
_Told = tuple[Points, NDArray[np.uint8], NDArray[np.float32], NDArray[np.int32]]


def _survey_points(current: Points, voxels: VoxelScores, objects: ChangeObjects) -> _Told:
    """Say of each point of the survey what it is."""
    rows, known = _rows(current, voxels, objects)
    number = np.where(known, objects.now[rows], 0).astype(np.int32)
    judged = known & voxels.judged[rows]
    kind = np.full(len(current), PointKind.UNCHANGED, np.uint8)
    kind[~judged] = PointKind.NOT_JUDGED
    kind[known & voxels.moving[rows]] = PointKind.MOVING
    kind[number > 0] = PointKind.APPEARED
    score = np.where(judged, voxels.appeared[rows], np.nan).astype(np.float32)
    return current, kind, score, number


def _lost_points(reference: Points, voxels: VoxelScores, objects: ChangeObjects) -> _Told:
    """Return the points of the map that are of objects and no longer there."""
    rows, known = _rows(reference, voxels, objects)
    lost = np.flatnonzero(known & (objects.before[rows] > 0))
    kind = np.full(len(lost), PointKind.DISAPPEARED, np.uint8)
    return reference[lost], kind, voxels.disappeared[rows[lost]], objects.before[rows[lost]]


def _rows(points: Points, voxels: VoxelScores, objects: ChangeObjects) -> tuple[NDArray[np.int64], Bools]:
    """Return (N,) the row of the voxel that each point (N, 3) lies in, and whether there is one."""
    rows = rows_of(Voxels.keys_of(points, size=objects.voxel_size), voxels.keys)
    return np.maximum(rows, 0), rows >= 0


def _colors(table: Mapping[Any, tuple[int, int, int]]) -> Colors:
    """Return (256, 3) the colour of each number."""
    colors = np.full((256, 3), _NOT_IN_A_TILE_COLOR, np.uint8)
    for number, color in table.items():
        colors[number] = color
    return colors
