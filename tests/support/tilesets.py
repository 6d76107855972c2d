"""Tilesets read back as a viewer reads them, without the code that writes them."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES: dict[int, np.dtype[Any]] = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5123: np.dtype("<u2"),
    5126: np.dtype("<f4"),
}
_WIDTHS = {"VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class Content:
    """A decoded GLB."""

    document: dict[str, Any]
    points: NDArray[np.float64]  #: (N, 3) metres, z up
    step: float  #: metres, of the quantisation
    attributes: dict[str, NDArray[Any]]  #: as they are stored


@dataclass(frozen=True)
class Tile:
    """One tile, with its depth in the tree and the error of what is above it."""

    box: NDArray[np.float64]  #: (2, 3) corners
    error: float
    parent_error: float
    uri: str | None
    depth: int


def decoded(glb: bytes) -> Content:
    """Decode the points of a GLB as the standards say."""
    magic, version, length = struct.unpack_from("<4sII", glb)
    assert (magic, version, length) == (b"glTF", 2, len(glb))
    size, kind = struct.unpack_from("<I4s", glb, 12)
    assert kind == b"JSON"
    document = json.loads(glb[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", glb, 20 + size)
    assert kind == b"BIN\0"
    binary = glb[28 + size : 28 + size + binary_size]
    (node,) = document["nodes"]
    (primitive,) = document["meshes"][node["mesh"]]["primitives"]
    assert primitive["mode"] == 0
    attributes = {name: _column(document, binary, number) for name, number in primitive["attributes"].items()}
    matrix = np.array(node["matrix"]).reshape(4, 4).T
    gltf = attributes["POSITION"] @ matrix[:3, :3].T + matrix[:3, 3]
    points = np.column_stack([gltf[:, 0], -gltf[:, 2], gltf[:, 1]])  # y up to z up, as 3D Tiles has it
    return Content(document=document, points=points, step=abs(matrix[0, 0]), attributes=attributes)


def _column(document: dict[str, Any], binary: bytes, number: int) -> NDArray[Any]:
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind, width = _TYPES[accessor["componentType"]], _WIDTHS[accessor["type"]]
    assert view["byteOffset"] % 4 == view["byteStride"] % 4 == 0
    return np.ndarray(
        (accessor["count"], width),
        kind,
        binary,
        offset=view["byteOffset"],
        strides=(view["byteStride"], kind.itemsize),
    ).copy()


def tiles_of(document: dict[str, Any]) -> Iterator[Tile]:
    """Yield every tile of a tileset.json, parents before their children."""
    assert document["asset"]["version"] == "1.1"
    assert document["root"]["refine"] == "ADD"
    waiting = [(document["root"], document["geometricError"], 0)]
    while waiting:
        tile, above, depth = waiting.pop()
        numbers = np.array(tile["boundingVolume"]["box"])
        half = numbers[[3, 7, 11]]
        yield Tile(
            box=np.array([numbers[:3] - half, numbers[:3] + half]),
            error=tile["geometricError"],
            parent_error=above,
            uri=tile.get("content", {}).get("uri"),
            depth=depth,
        )
        waiting += [(child, tile["geometricError"], depth + 1) for child in tile.get("children", ())]


def content_in(contents: bytes) -> Callable[[str], Content]:
    """Return what decodes a content by its address, out of the file of all."""

    def read(uri: str) -> Content:
        offset, length = (int(part) for part in uri.rpartition("/")[2].removesuffix(".glb").split("-")[-2:])
        return decoded(contents[offset : offset + length])

    return read
