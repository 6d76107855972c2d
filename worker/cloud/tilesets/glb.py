"""Points as GLB (glTF 2.0, ISO/IEC 12113:2022): quantised positions, and colours or normals.

Positions are 16-bit numbers on a grid of their own (KHR_mesh_quantization); the node's matrix leads to the frame of the
tile. glTF's y axis points up, and readers of 3D Tiles turn it back (OGC 22-025r4, 6.7.1.6.2.1), so the matrix turns z to
y as well. What is interleaved with padding is what vertex buffers need: attributes begin at multiples of 4 bytes.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Floats, Points

MEDIA_TYPE = "model/gltf-binary"

#: What three bytes of each point are: red, green, blue as in a picture (sRGB), or a normal in 127ths.
Extra = Literal["color", "normal"]

_STEPS = 65535
_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_ARRAY_BUFFER, _POINTS = 34962, 0
_BYTE, _UNSIGNED_BYTE, _UNSIGNED_SHORT = 5120, 5121, 5123

#: glTF's colours are linear (Section 3.7.2.1); bytes of a picture are not (IEC 61966-2-1).
_LINEAR = np.array([value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
                    for value in (byte / 255 for byte in range(256))])  # fmt: skip
LINEAR_BYTES: NDArray[np.uint8] = np.rint(_LINEAR * 255).astype(np.uint8)

#: Colours are shown as they are; a cloud without them is a dull light grey that light falls on.
_MATERIALS: dict[str | None, dict[str, Any]] = {
    "color": {
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
        "extensions": {"KHR_materials_unlit": {}},
    },
    "normal": {
        "pbrMetallicRoughness": {
            "baseColorFactor": [0.7, 0.7, 0.7, 1],
            "metallicFactor": 0,
            "roughnessFactor": 1,
        }
    },
}
_MATERIALS[None] = {**_MATERIALS["normal"], "extensions": {"KHR_materials_unlit": {}}}


@dataclass(frozen=True, kw_only=True, slots=True)
class Quantisation:
    """A grid of 65,536 steps a side; the step is the same along every axis, so that normals stay as they are."""

    lower: Floats  #: (3,) metres
    step: float  #: metres; no point is moved by more than half of it along an axis

    @classmethod
    def of(cls, points: Points) -> Quantisation:
        """Return the finest grid that holds points (N, 3), of which there is at least one."""
        lower = points.min(axis=0).astype(np.float64)
        widest = float((points.max(axis=0) - lower).max())
        return cls(lower=lower, step=widest / _STEPS or 1e-6)

    def applied(self, points: Points) -> NDArray[np.uint16]:
        """Return the steps (N, 3) of points (N, 3)."""
        steps = np.rint((points - self.lower) / self.step)
        return np.clip(steps, 0, _STEPS).astype(np.uint16)

    @property
    def matrix(self) -> list[float]:
        """From steps to metres in glTF's axes, (x, z, -y) of the tile's; column by column."""
        step, (x, y, z) = self.step, (float(value) for value in self.lower)
        return [step, 0, 0, 0, 0, 0, -step, 0, 0, step, 0, 0, x, z, -y, 1]


def encode_points(
    points: Points, extra: NDArray[np.uint8] | None = None, *, extra_is: Extra | None = None
) -> bytes:
    """Return the GLB of points (N, 3), metres, z up, at least one, and of the `extra` bytes (N, 3) of each."""
    grid = Quantisation.of(points)
    steps = grid.applied(points)
    columns = [_padded(steps, 8)]
    accessors = [_accessor(0, _UNSIGNED_SHORT, "VEC3", len(points)) | _limits(steps)]
    attributes = {"POSITION": 0}
    if extra is not None and extra_is == "color":
        opaque = np.full((len(points), 1), 255, np.uint8)
        columns.append(np.hstack([LINEAR_BYTES[extra], opaque]))
        accessors.append(_accessor(1, _UNSIGNED_BYTE, "VEC4", len(points), normalized=True))
        attributes["COLOR_0"] = 1
    elif extra is not None:
        columns.append(_padded(extra, 4))
        accessors.append(_accessor(1, _BYTE, "VEC3", len(points), normalized=True))
        attributes["NORMAL"] = 1
    binary = b"".join(column.tobytes() for column in columns)
    material = _MATERIALS[extra_is if extra is not None else None]
    document = {
        "asset": {"version": "2.0", "generator": "SPICD"},
        "extensionsUsed": ["KHR_mesh_quantization", *material.get("extensions", {})],
        "extensionsRequired": ["KHR_mesh_quantization"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": grid.matrix}],
        "meshes": [{"primitives": [{"attributes": attributes, "mode": _POINTS, "material": 0}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": _views(columns),
        "buffers": [{"byteLength": len(binary)}],
    }
    return _container(json.dumps(document, separators=(",", ":")).encode(), binary)


def _padded(values: NDArray[Any], width: int) -> NDArray[np.uint8]:
    """Return the bytes of the rows, each `width` long."""
    rows = np.zeros((len(values), width), np.uint8)
    own = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
    rows[:, : own.shape[1]] = own
    return rows


def _accessor(
    view: int, component: int, kind: str, count: int, *, normalized: bool = False
) -> dict[str, Any]:
    accessor = {"bufferView": view, "componentType": component, "type": kind, "count": count}
    return accessor | ({"normalized": True} if normalized else {})


def _limits(steps: NDArray[np.uint16]) -> dict[str, Any]:
    return {"min": steps.min(axis=0).tolist(), "max": steps.max(axis=0).tolist()}


def _views(columns: list[NDArray[np.uint8]]) -> list[dict[str, int]]:
    views, offset = [], 0
    for column in columns:
        views.append(
            {
                "buffer": 0,
                "byteOffset": offset,
                "byteLength": column.size,
                "byteStride": column.shape[1],
                "target": _ARRAY_BUFFER,
            }
        )
        offset += column.size
    return views


def _container(document: bytes, binary: bytes) -> bytes:
    """Return both in chunks (Section 4), the first filled up to a multiple of 4 bytes, as the other is."""
    document += b" " * (-len(document) % 4)
    length = 12 + 8 + len(document) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<III", _MAGIC, _VERSION, length),
            struct.pack("<II", len(document), _JSON),
            document,
            struct.pack("<II", len(binary), _BIN),
            binary,
        ]
    )
