"""The scene's readers and sums, in TypeScript, against files that the exporter writes: run by Node's own test runner."""

from __future__ import annotations

import json
import os
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from worker.cloud.formats.ply import write_ply
from worker.pipeline.results.changes import TileState
from worker.pipeline.results.export import KIND_COLORS, STATE_COLORS, PointKind
from worker.pipeline.results.object_marks import OBJECT_COLORS

ROOT = Path(__file__).parents[3]
NODES = (ROOT / "build/node/bin/node", ROOT / "build/tools/bin/node")
NODE = next((path for path in NODES if path.exists()), None)

pytestmark = pytest.mark.skipif(NODE is None, reason="no Node on this machine: `make web` installs it")


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A map's cloud, coloured and not; a survey's by kinds, and by states of tiles; a tile; and what is in them."""
    points = np.random.default_rng(1).uniform(0, 5, (1000, 3)).astype(np.float32)
    kinds = np.repeat([kind.value for kind in PointKind], [600, 150, 100, 100, 50]).astype(np.uint8)
    states = np.repeat([TileState.UNCHANGED, TileState.CHANGED, 255], [500, 300, 200]).astype(np.uint8)
    colors = np.tile(np.array([10, 20, 30], np.uint8), (1000, 1))
    score = np.linspace(0, 1, 1000, dtype=np.float32)
    write_ply(tmp_path / "map.ply", points)
    write_ply(tmp_path / "coloured.ply", points, colors=colors)
    by_kind: dict[str, Any] = {
        "change_score": score,
        "tile_state": states,
        "kind": kinds,
        "object_id": kinds.astype(np.int32),
    }
    write_ply(
        tmp_path / "survey.ply", points, colors=colors, scalars=by_kind, quality=score, comments=["one"]
    )
    by_tile: dict[str, Any] = {"change_score": score, "tile_state": states}
    write_ply(tmp_path / "tiles.ply", points, colors=colors, scalars=by_tile)
    (tmp_path / "tile.glb").write_bytes(glb())
    told = {
        "map": {"n": 1000, "first": [float(value) for value in points[:2].ravel()]},
        "survey": {"n": 1000, "unchanged": 600, "appeared": 150, "lost": 100, "unjudged": 100, "moving": 50},
        "glb": {"positions": [10, 30, -20, 10.1, 30.3, -20.2], "colours": [255, 0, 0, 0, 255, 0]},
        "kinds": {kind: css(color) for kind, color in OBJECT_COLORS.items()},
        "states": {state.label: css(color) for state, color in STATE_COLORS.items()},
    }
    (tmp_path / "expected.json").write_text(json.dumps(told))
    return tmp_path


def css(color: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


def glb() -> bytes:
    """Return two points at (10, 20, 30) and (10.1, 20.2, 30.3), metres, z up, in steps of 0.1 m, red and green."""
    binary = struct.pack("<3Hxx3Hxx4B4B", 0, 0, 0, 1, 2, 3, 255, 0, 0, 255, 0, 255, 0, 255)
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": 0, "byteLength": 16, "byteStride": 8},
        {"buffer": 0, "byteOffset": 16, "byteLength": 8, "byteStride": 4},
    ]
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0, "matrix": [0.1, 0, 0, 0, 0, 0, -0.1, 0, 0, 0.1, 0, 0, 10, 30, -20, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "type": "VEC3", "count": 2},
            {"bufferView": 1, "componentType": 5121, "type": "VEC4", "count": 2, "normalized": True},
        ],
        "bufferViews": views,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_the_scene_reads_what_the_service_writes(files: Path) -> None:
    assert NODE is not None
    ended = subprocess.run(
        [str(NODE), "--test", "--test-reporter=spec", str(Path(__file__).with_name("scene.test.ts"))],
        env={**os.environ, "FILES": str(files), "NODE_NO_WARNINGS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert KIND_COLORS[PointKind.APPEARED] == OBJECT_COLORS["appeared"]
    assert KIND_COLORS[PointKind.DISAPPEARED] == OBJECT_COLORS["disappeared"]
