"""A cloud as 3D Tiles 1.1 (OGC 22-025r4): an octree of GLB contents with ADD refinement, written out of core.

The points are read twice: first counted in the cells of a coarse grid, then sorted into parts, subtrees of as many points
as memory may hold, in files. Each part is built from its leaves upwards; what stands for the coarser cells of its parent
goes on there, which is never more than the samples of a few nodes. So memory does not grow with the cloud, and the cost
is a sort of each part. All contents stand one after the other in one file: their addresses say where.
"""

from __future__ import annotations

import functools
import hashlib
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from worker.cloud.settings import StrictModel
from worker.cloud.tilesets.glb import Extra, encode_points
from worker.cloud.tilesets.octree import DEEPEST, Codes, Cube, node_of, samples
from worker.cloud.types import Colors, Floats, Normals, Points

BYTES_A_POINT = (
    96  #: that a part takes while it is built: rows, places, hashes, an order, and copies of these
)
_AT_ONCE = 1_000_000  # points that are read together
_COUNTED = 7  # level of the nodes that points are counted in: 128 a side


class TilesetSettings(StrictModel):
    """How a tileset is cut."""

    memory_bytes: int = Field(256 << 20, gt=0, description="about what its writing may take")
    leaf_points: int = Field(65_536, gt=0, description="a node with no more below it has no children")


@dataclass(frozen=True, kw_only=True, slots=True)
class Piece:
    """Some of the points of a cloud."""

    points: Points  #: (N, 3) metres, z up
    colors: Colors | None = None  #: (N, 3)
    normals: Normals | None = None  #: (N, 3); not kept where there are colours


#: Each call gives the same pieces from the beginning.
Pieces = Callable[[], Iterable[Piece]]


@dataclass(frozen=True, kw_only=True, slots=True)
class TilesetSummary:
    """What was written."""

    n_points: int
    contents: int  #: tiles with points
    bytes: int  #: of all contents
    sha256: str  #: of the same, hexadecimal


@dataclass(frozen=True, kw_only=True, slots=True)
class Content:
    """Where a content lies."""

    sha256: str  #: of the file of all contents, hexadecimal
    offset: int  #: in it
    length: int  #: bytes


def pieces_of(
    points: Points, *, colors: Colors | None = None, normals: Normals | None = None, at_once: int = _AT_ONCE
) -> Iterator[Piece]:
    """Yield the points (N, 3) of a cloud, which may be a memory map, some at a time."""
    for start in range(0, len(points), at_once):
        here = slice(start, start + at_once)
        yield Piece(
            points=np.asarray(points[here]),
            colors=None if colors is None else np.asarray(colors[here]),
            normals=None if normals is None else np.asarray(normals[here]),
        )


def write_tileset(
    index: Path,
    contents: Path,
    pieces: Pieces,
    *,
    scratch: Path,
    address: Callable[[Content], str] = lambda at: f"tileset/{at.offset}-{at.length}.glb",
    settings: TilesetSettings | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> TilesetSummary:
    """Write the tileset of a cloud of at least one point: the document `index`, and all contents in one file.

    `scratch` is an existing folder for as many bytes as the points take. `address` gives the relative one of a content.
    The same points give the same bytes, whatever the memory. Raises ValueError for a cloud without a point.
    """
    settings = settings or TilesetSettings()
    most = max(settings.memory_bytes // BYTES_A_POINT, settings.leaf_points)
    pieces = functools.partial(_smaller, pieces, most)
    lower, upper, n_points, extra_is = _surveyed(pieces)
    cube = Cube.around(lower, upper)
    with tempfile.TemporaryDirectory(dir=scratch) as folder, contents.open("wb") as file:
        counts = _counted(pieces, cube)
        parts = _Parts(folder=Path(folder), row=_row_of(extra_is), most=most, counts=counts)
        progress(0.1)
        parts.fill(pieces, cube, extra_is)
        progress(0.3)
        builder = _Builder(
            file=file,
            cube=cube,
            parts=parts,
            extra_is=extra_is,
            settings=settings,
            written=lambda done: progress(0.3 + 0.7 * done / n_points),
        )
        root = builder.build_root()
    sha256 = builder.digest.hexdigest()
    for tile, offset, length in builder.contents:
        tile["content"] = {"uri": address(Content(sha256=sha256, offset=offset, length=length))}
    document = {
        "asset": {"version": "1.1", "generator": "SPICD"},
        "geometricError": _rounded(cube.side),  # of nothing at all
        "root": root | {"refine": "ADD"},
    }
    index.write_text(json.dumps(document, separators=(",", ":")), encoding="utf-8")
    return TilesetSummary(
        n_points=n_points, contents=len(builder.contents), bytes=contents.stat().st_size, sha256=sha256
    )


def _smaller(pieces: Pieces, most: int) -> Iterator[Piece]:
    """Yield the pieces, cut to at most so many points."""
    for piece in pieces():
        yield from pieces_of(piece.points, colors=piece.colors, normals=piece.normals, at_once=most)


def _surveyed(pieces: Pieces) -> tuple[NDArray[np.float32], NDArray[np.float32], int, Extra | None]:
    """Return the corners of the box around all points, their number, and what else is known of each."""
    lower, upper = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
    n_points, extra_is = 0, None
    for piece in pieces():
        if len(piece.points):
            lower = np.minimum(lower, piece.points.min(axis=0))
            upper = np.maximum(upper, piece.points.max(axis=0))
            n_points += len(piece.points)
            extra_is = _kind_of(piece)
    if not n_points:
        raise ValueError("a tileset of no point")
    return lower, upper, n_points, extra_is


def _kind_of(piece: Piece) -> Extra | None:
    if piece.colors is not None:
        return "color"
    return "normal" if piece.normals is not None else None


def _counted(pieces: Pieces, cube: Cube) -> NDArray[np.int64]:
    """Return (8^7,) the points in each node of the level that points are counted in."""
    counts = np.zeros(8**_COUNTED, np.int64)
    for piece in pieces():
        nodes = node_of(cube.codes(piece.points), _COUNTED).astype(np.int64)
        found, here = np.unique(nodes, return_counts=True)
        counts[found] += here
    return counts


def _row_of(extra_is: Extra | None) -> np.dtype[Any]:
    """Return how a point lies in the file of a part."""
    extra = [] if extra_is is None else [("extra", np.uint8, (3,))]
    return np.dtype([("point", np.float32, (3,)), *extra])


@dataclass(frozen=True, kw_only=True, slots=True)
class _Parts:
    """Points in files, one for each subtree that memory holds."""

    folder: Path
    row: np.dtype[Any]
    most: int  #: points of a part
    counts: NDArray[np.int64]  #: by node of the level `_COUNTED`

    def count(self, level: int, node: int) -> int:
        """Return the points in a node at or above the level in which they are counted."""
        width = 8 ** (_COUNTED - level)
        return int(self.counts[node * width : (node + 1) * width].sum())

    def is_part(self, level: int, node: int) -> bool:
        """Tell whether a node is built in memory; one that counts say no more of has to be."""
        return level == _COUNTED or self.count(level, node) <= self.most

    def fill(self, pieces: Pieces, cube: Cube, extra_is: Extra | None) -> None:
        """Sort the points into the files."""
        names = list(self._listed(0, 0))
        starts = np.array([node << (3 * (_COUNTED - level)) for level, node in names], np.int64)
        for piece in pieces():
            if not len(piece.points):
                continue
            nodes = node_of(cube.codes(piece.points), _COUNTED).astype(np.int64)
            part = np.searchsorted(starts, nodes, side="right") - 1
            order = np.argsort(part, kind="stable")
            rows = self._rows(piece, extra_is)[order]
            ends = np.searchsorted(part[order], np.arange(len(names)), side="right")
            for (level, node), begin, end in zip(names, np.r_[0, ends[:-1]], ends, strict=True):
                if end > begin:
                    with self._path(level, node).open("ab") as file:
                        rows[begin:end].tofile(file)

    def load(self, level: int, node: int) -> NDArray[Any]:
        """Return the rows of a part and give up its file."""
        path = self._path(level, node)
        rows = np.fromfile(path, self.row)
        path.unlink()
        return rows

    def _listed(self, level: int, node: int) -> Iterator[tuple[int, int]]:
        """Yield the parts in the order of their places."""
        if not self.count(level, node):
            return
        if self.is_part(level, node):
            yield level, node
            return
        for child in range(8 * node, 8 * node + 8):
            yield from self._listed(level + 1, child)

    def _rows(self, piece: Piece, extra_is: Extra | None) -> NDArray[Any]:
        rows = np.empty(len(piece.points), self.row)
        rows["point"] = piece.points
        if extra_is == "color":
            rows["extra"] = piece.colors
        elif piece.normals is not None and extra_is == "normal":
            rows["extra"] = np.rint(piece.normals * 127).astype(np.int8).view(np.uint8)
        return rows

    def _path(self, level: int, node: int) -> Path:
        return self.folder / f"tileset-part-{level}-{node}"


@dataclass(frozen=True, kw_only=True, slots=True)
class _Points:
    """Points in the order of their places."""

    codes: Codes  #: (N,) ascending
    rows: NDArray[Any]  #: (N,)

    def __getitem__(self, at: Any) -> _Points:
        return _Points(codes=self.codes[at], rows=self.rows[at])


@dataclass(frozen=True, kw_only=True, slots=True)
class _Node:
    """A subtree that is written but for its samples, which are its parent's to show."""

    tile: dict[str, Any] | None  #: as it stands in the document; None: no point is left below
    samples: _Points
    lower: Floats  #: (3,) metres, of all its points
    upper: Floats  #: (3,)


@dataclass(kw_only=True, slots=True)
class _Builder:
    """Builds nodes from the leaves upwards and writes their contents."""

    file: BinaryIO
    cube: Cube
    parts: _Parts
    extra_is: Extra | None
    settings: TilesetSettings
    written: Callable[[int], None]
    contents: list[tuple[dict[str, Any], int, int]] = field(default_factory=list)  #: tile, offset, length
    digest: Any = field(default_factory=hashlib.sha256)
    points: int = 0

    def build_root(self) -> dict[str, Any]:
        """Return the tile of everything."""
        tile = self._on_disk(0, 0).tile
        if tile is None:
            raise ValueError("a tileset of no point")
        return tile

    def _on_disk(self, level: int, node: int) -> _Node:
        """Build a node whose points lie in one part or in several."""
        if self.parts.is_part(level, node):
            rows = self.parts.load(level, node)
            codes = self.cube.codes(rows["point"])
            order = np.argsort(codes, kind="stable")
            return self._in_memory(level, _Points(codes=codes[order], rows=rows[order]))
        children = range(8 * node, 8 * node + 8)
        return self._joined(
            level,
            [self._on_disk(level + 1, child) for child in children if self.parts.count(level + 1, child)],
        )

    def _in_memory(self, level: int, points: _Points) -> _Node:
        """Build a node whose points are all here."""
        if len(points.codes) <= self.settings.leaf_points or level == DEEPEST:
            return self._written(level, points, [])
        nodes = node_of(points.codes, level + 1)
        starts = np.flatnonzero(np.r_[True, nodes[1:] != nodes[:-1]])
        ends = np.r_[starts[1:], len(nodes)]
        return self._joined(
            level,
            [self._in_memory(level + 1, points[begin:end]) for begin, end in zip(starts, ends, strict=True)],
        )

    def _joined(self, level: int, children: Sequence[_Node]) -> _Node:
        """Build a node that shows what stands for its cells, over its children."""
        own = _Points(
            codes=np.concatenate([child.samples.codes for child in children]),
            rows=np.concatenate([child.samples.rows for child in children]),
        )
        return self._written(level, own, children)

    def _written(self, level: int, own: _Points, children: Sequence[_Node]) -> _Node:
        """Write what of its own points a node shows itself: those that no coarser cell needs."""
        upwards = samples(own.codes, level - 1) if level else np.zeros(len(own.codes), bool)
        shown = own.rows[~upwards]
        lower, upper = _box(own, children)
        tiles = [child.tile for child in children if child.tile is not None]
        tile: dict[str, Any] | None = None
        if len(shown) or tiles:
            error = self.cube.spacing(level) if tiles else 0.0
            tile = {"boundingVolume": {"box": _box_of(lower, upper)}, "geometricError": _rounded(error)}
            if len(shown):
                self._keep(shown, tile)
            if tiles:
                tile["children"] = tiles
        return _Node(tile=tile, samples=own[upwards], lower=lower, upper=upper)

    def _keep(self, rows: NDArray[Any], tile: dict[str, Any]) -> None:
        """Write the content of a tile; its address is known once all are written."""
        extra = rows["extra"] if self.extra_is is not None else None
        content = encode_points(rows["point"], extra, extra_is=self.extra_is)
        self.contents.append((tile, self.file.tell(), len(content)))
        self.file.write(content)
        self.digest.update(content)
        self.points += len(rows)
        self.written(self.points)


def _box(own: _Points, children: Sequence[_Node]) -> tuple[Floats, Floats]:
    """Return the corners of the box around a node's points and its children."""
    points = own.rows["point"].astype(np.float64)
    lower = np.min([points.min(axis=0), *(child.lower for child in children)], axis=0)
    upper = np.max([points.max(axis=0), *(child.upper for child in children)], axis=0)
    return lower, upper


def _box_of(lower: Floats, upper: Floats) -> list[float]:
    """Return middle and half axes, wider by what quantisation may move a point."""
    middle = (lower + upper) / 2
    half = (upper - lower) / 2 + float((upper - lower).max()) / 65535 + 1e-4
    x, y, z = (_rounded(value) for value in half)
    return [*(_rounded(value) for value in middle), x, 0, 0, 0, y, 0, 0, 0, z]


def _rounded(value: float) -> float:
    return round(float(value), 5)
