"""A cloud as a tileset: every point once, in its box, as exactly as promised, in bounded memory."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tests.support.tilesets import Content, Tile, content_in, tiles_of
from worker.cloud.tilesets import writer
from worker.cloud.tilesets.glb import LINEAR_BYTES
from worker.cloud.tilesets.writer import (
    BYTES_A_POINT,
    Piece,
    TilesetSettings,
    TilesetSummary,
    pieces_of,
    write_tileset,
)
from worker.cloud.types import Points

SMALL = TilesetSettings(leaf_points=500, memory_bytes=BYTES_A_POINT * 2000)


@dataclass(frozen=True)
class Written:
    """A tileset on the disk, read back."""

    summary: TilesetSummary
    index: bytes
    contents: bytes
    tiles: list[Tile]

    def decoded(self) -> Iterator[tuple[Tile, Content]]:
        read = content_in(self.contents)
        for tile in self.tiles:
            if tile.uri is not None:
                yield tile, read(tile.uri)


def floors(count: int = 20_000, *, extent: float = 30.0, seed: int = 3) -> Points:
    """Two floors and a wall, far from the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, extent, (count, 3)).astype(np.float32)
    points[: count // 2, 2] = 0.0
    points[count // 2 : -1000, 2] = 3.0
    points[-1000:, 0] = 1.0
    return points + np.array([-200, 350, 12], np.float32)


def written(
    folder: Path, points: Points, *, settings: TilesetSettings = SMALL, at_once: int = 3000, **columns: Any
) -> Written:
    folder.mkdir(exist_ok=True)
    index, contents = folder / "tileset.json", folder / "tileset.bin"
    summary = write_tileset(
        index,
        contents,
        lambda: pieces_of(points, at_once=at_once, **columns),
        scratch=folder,
        settings=settings,
    )
    assert sorted(path.name for path in folder.iterdir()) == ["tileset.bin", "tileset.json"]
    text = index.read_bytes()
    return Written(
        summary=summary,
        index=text,
        contents=contents.read_bytes(),
        tiles=list(tiles_of(json.loads(text))),
    )


def matched(points: Points, found: NDArray[Any]) -> NDArray[np.int64]:
    """The row of `points` that each found point is nearest to; fails unless it is one to one."""
    _, rows = cKDTree(points).query(found)
    assert len(found) == len(points)
    assert len(np.unique(rows)) == len(points)
    return np.asarray(rows)


def test_every_point_is_in_one_content_and_not_moved_by_more_than_half_a_step(tmp_path: Path) -> None:
    points = floors()
    tileset = written(tmp_path, points)
    parts = [content for _, content in tileset.decoded()]
    found = np.concatenate([part.points for part in parts])
    half = np.concatenate([np.full(len(part.points), part.step / 2) for part in parts])
    rows = matched(points, found)
    assert (np.abs(found - points[rows]) <= half[:, None] * 1.001 + 1e-9).all()
    assert max(half) < 0.0003  # of 30 m
    assert tileset.summary == TilesetSummary(
        n_points=len(points),
        contents=len(parts),
        bytes=len(tileset.contents),
        sha256=hashlib.sha256(tileset.contents).hexdigest(),
    )


def test_boxes_hold_the_points_of_their_tiles_and_those_below(tmp_path: Path) -> None:
    tileset = written(tmp_path, floors())
    stack: list[Tile] = []
    read = content_in(tileset.contents)
    for tile in tileset.tiles:
        del stack[tile.depth :]
        stack.append(tile)
        for holder in stack if tile.uri is not None else ():
            points = read(str(tile.uri)).points
            assert (points >= holder.box[0]).all()
            assert (points <= holder.box[1]).all()


def test_geometric_errors_fall_from_the_root_to_zero_at_the_leaves(tmp_path: Path) -> None:
    tileset = written(tmp_path, floors())
    assert max(tile.depth for tile in tileset.tiles) >= 2
    assert all(tile.error < tile.parent_error for tile in tileset.tiles)
    depths: dict[int, set[float]] = {}
    for tile in tileset.tiles:
        if tile.error:
            depths.setdefault(tile.depth, set()).add(tile.error)
    levels = [depths[depth] for depth in sorted(depths)]
    assert all(len(errors) == 1 for errors in levels)
    assert [errors.pop() for errors in levels] == pytest.approx(
        [30 / 64 / 2**n for n in range(len(levels))], rel=1e-3
    )


def test_what_is_shown_first_is_spread_over_the_whole_cloud(tmp_path: Path) -> None:
    points = floors(60_000)
    tileset = written(tmp_path, points)
    root = tileset.tiles[0]
    first = content_in(tileset.contents)(str(root.uri)).points
    assert len(first) < len(points) / 3
    distance, _ = cKDTree(first).query(points)
    assert distance.max() < root.error * np.sqrt(3)  # a sample in every cell that holds a point


@pytest.mark.parametrize("parts", [1, 3, 30])
def test_the_same_bytes_come_of_any_memory_and_any_pieces(tmp_path: Path, parts: int) -> None:
    points = floors()
    once = written(tmp_path / "once", points)
    memory = max(len(points) // parts, SMALL.leaf_points) * BYTES_A_POINT
    settings = SMALL.with_values(memory_bytes=memory)
    again = written(tmp_path / "again", points, settings=settings, at_once=len(points) // parts)
    assert (again.index, again.contents) == (once.index, once.contents)


def test_memory_holds_a_part_and_a_piece_whatever_the_size_of_the_cloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is loaded, joined and read together is counted, for clouds of which one is eight times as large."""
    held: list[int] = []
    load, joined, rows = writer._Parts.load, writer._Builder._joined, writer._Parts._rows

    def loading(self: writer._Parts, level: int, node: int) -> NDArray[Any]:
        rows = load(self, level, node)
        held.append(len(rows))
        return rows

    def joining(self: Any, level: int, children: Any) -> Any:
        held.append(sum(len(child.samples.codes) for child in children))
        return joined(self, level, children)

    def sorting(self: writer._Parts, piece: Piece, extra_is: Any) -> NDArray[Any]:
        held.append(len(piece.points))
        return rows(self, piece, extra_is)

    monkeypatch.setattr(writer._Parts, "_rows", sorting)
    monkeypatch.setattr(writer._Parts, "load", loading)
    monkeypatch.setattr(writer._Builder, "_joined", joining)
    most = {}
    for count, extent in ((10_000, 30.0), (80_000, 85.0)):
        held.clear()
        written(tmp_path / str(count), floors(count, extent=extent))
        most[count] = max(held)
        assert sum(held) > 2 * count  # all of it went through, twice
    part, samples = SMALL.memory_bytes // BYTES_A_POINT, 3 * 64**2  # of three surfaces in a node
    assert most[10_000] <= max(part, samples)
    assert most[80_000] <= max(part, samples)


def test_colours_are_linear_and_normals_stand_where_there_are_no_colours(tmp_path: Path) -> None:
    points = floors(3000)
    rng = np.random.default_rng(1)
    colors = rng.integers(0, 256, (len(points), 3)).astype(np.uint8)
    normals = rng.normal(size=(len(points), 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    coloured = written(tmp_path / "a", points, colors=colors, normals=normals)
    for _, content in coloured.decoded():
        rows = cKDTree(points).query(content.points)[1]
        assert set(content.attributes) == {"POSITION", "COLOR_0"}
        np.testing.assert_array_equal(content.attributes["COLOR_0"][:, :3], LINEAR_BYTES[colors[rows]])
        assert (content.attributes["COLOR_0"][:, 3] == 255).all()
        assert "KHR_materials_unlit" in content.document["extensionsUsed"]
    grey = written(tmp_path / "b", points, normals=normals)
    for _, content in grey.decoded():
        rows = cKDTree(points).query(content.points)[1]
        # a normal turns with the matrix of the node, which is not part of the points as they are stored
        np.testing.assert_allclose(content.attributes["NORMAL"] / 127, normals[rows], atol=0.005)


def test_linear_bytes_are_those_of_srgb() -> None:
    assert LINEAR_BYTES[[0, 10, 128, 188, 255]].tolist() == [0, 1, 55, 128, 255]


@pytest.mark.parametrize("count", [1, 2, 700])
def test_points_at_one_place_are_all_kept(tmp_path: Path, count: int) -> None:
    points = np.full((count, 3), 7.5, np.float32)
    tileset = written(tmp_path, points)
    found = np.concatenate([content.points for _, content in tileset.decoded()])
    np.testing.assert_allclose(found, points, atol=1e-5)
    assert len(found) == count


def test_what_an_earlier_run_left_in_the_folder_does_not_matter(tmp_path: Path) -> None:
    points = floors(3000)
    once = written(tmp_path / "once", points)
    folder = tmp_path / "again"
    folder.mkdir()

    def torn() -> Iterator[Piece]:
        yield from pieces_of(points[:2000], at_once=1000)
        if any(path.is_dir() for path in folder.iterdir()):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_tileset(folder / "tileset.json", folder / "tileset.bin", torn, scratch=folder, settings=SMALL)
    again = written(folder, points)
    assert (again.index, again.contents) == (once.index, once.contents)


def test_progress_never_falls_and_ends_at_one(tmp_path: Path) -> None:
    points = floors(5000)
    told: list[float] = []
    files = tmp_path / "tileset.json", tmp_path / "tileset.bin"
    write_tileset(*files, lambda: pieces_of(points), scratch=tmp_path, settings=SMALL, progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_no_point_makes_no_tileset(tmp_path: Path) -> None:
    files = tmp_path / "tileset.json", tmp_path / "tileset.bin"
    with pytest.raises(ValueError, match="no point"):
        write_tileset(*files, lambda: [Piece(points=np.empty((0, 3), np.float32))], scratch=tmp_path)
