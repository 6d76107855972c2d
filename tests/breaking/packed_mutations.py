"""Small sound E57, LAS and LAZ files, and what may be wrong with them, by their structure."""

from __future__ import annotations

import random
import re
import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pye57 import libe57

from tests.breaking.scan_mutations import FLOATS, NUMBERS
from tests.support.clouds import (
    split_xml,
    with_checksums,
    with_xml,
    without_checksums,
    write_e57,
    write_e57_nodes,
    write_las,
)

N = 400  #: points of a sound file
#: Of a LAS: where numbers stand in its header, and their types.
_LAS_NUMBERS = (
    (24, "B"), (25, "B"), (94, "H"), (96, "I"), (100, "I"), (104, "B"), (105, "H"), (107, "I"), (131, "d"), (139, "d"),
    (147, "d"), (155, "d"), (163, "d"), (171, "d"), (227, "Q"), (235, "Q"), (243, "I"), (247, "Q"),
)  # fmt: skip
_E57_NUMBERS = (
    (8, "I"),
    (12, "I"),
    (16, "Q"),
    (24, "Q"),
    (32, "Q"),
    (40, "Q"),
    (48, "Q"),
    (56, "Q"),
    (64, "Q"),
)
_XML_WORDS = (
    b"", b"nan", b"inf", b"1e400", b"-1", b"<", b">", b"&#0;", b"&amp;", b"<![CDATA[", b"]]>", b"Integer",
    b"ScaledInteger", b"Float", b"Structure", b"Vector", b"CompressedVector", b"String", b"Blob", b"cartesianX",
    b"sphericalRange", b"minimum", b"maximum", b"scale", b"offset", b"\xff", b"A" * 3000, b"<a>" * 40, b"<!DOCTYPE a>",
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"precision=\"single\"", b"/",
)  # fmt: skip


@dataclass(frozen=True)
class PackedSample:
    """A sound file."""

    name: str
    content: bytes

    def mutated(self, rng: random.Random) -> bytes:
        """Return the file with one to four things wrong with it, or none."""
        content = self.content
        for _ in range(rng.choice((0, 1, 1, 1, 1, 2, 2, 3, 4))):
            content = _of_e57(content, rng) if self.name.startswith("e57") else _of_las(content, rng)
        return content[: rng.randrange(len(content) + 1)] if rng.random() < 0.05 else content


def packed_samples() -> list[PackedSample]:
    """Return a sound file of every kind that is read."""
    rng = np.random.default_rng(0)
    points = np.round(rng.uniform(-3, 3, (N, 3)), 3)
    with tempfile.TemporaryDirectory() as folder:
        made = [
            PackedSample(f"{kind} {form}", _las(Path(folder) / f"room.{kind}", points, form))
            for kind in ("las", "laz")
            for form in (0, 3, 5, 6, 7, 10)
        ]
        return made + _e57s(Path(folder), points)


def _las(path: Path, points: np.ndarray, form: int) -> bytes:
    colors = (np.abs(points) * 1000).astype(np.uint16) if form in (3, 5, 7, 10) else None
    withheld = np.arange(N) == 3
    extra = 2 if form == 7 else 0
    write_las(path, points, point_format=form, colors=colors, withheld=withheld, extra=extra)
    return path.read_bytes()


def _e57s(folder: Path, points: np.ndarray) -> list[PackedSample]:
    invalid, colors = (np.arange(N) == 3).astype("b"), (np.abs(points) * 60).astype("u1")
    xyz = ("cartesianX", "cartesianY", "cartesianZ")
    scaled = {name: (_scaled, values) for name, values in zip(xyz, points.T, strict=True)}
    state = {"cartesianInvalidState": (lambda image: libe57.IntegerNode(image, 0, 0, 2), invalid)}
    turned = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
    angles = {name: (_double, np.abs(values)) for name, values in zip(turned, points.T, strict=True)}
    away = {"sphericalInvalidState": (lambda image: libe57.IntegerNode(image, 0, 0, 2), invalid)}
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    return [
        PackedSample("e57 float", _read(write_e57(
            folder / "a.e57", [points], poses=[pose], colors=[colors], invalid=invalid,
        ))),
        PackedSample("e57 scaled", _read(write_e57_nodes(folder / "b.e57", scaled | state))),
        PackedSample("e57 spherical", _read(write_e57_nodes(folder / "c.e57", angles | away))),
    ]  # fmt: skip


def _scaled(image: libe57.ImageFile) -> libe57.ScaledIntegerNode:
    return libe57.ScaledIntegerNode(image, 0, -4000, 4000, 0.001, 0)


def _double(image: libe57.ImageFile) -> libe57.FloatNode:
    return libe57.FloatNode(image, 0, libe57.E57_DOUBLE, -10, 10)


def _read(path: Path) -> bytes:
    return path.read_bytes()


def _of_las(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    if rng.random() < 0.45:
        _number_at(data, *rng.choice(_LAS_NUMBERS), rng)
    elif rng.random() < 0.3 and len(data) > 110:  # how the points are packed, and the table of their chunks
        start = int(struct.unpack_from("<I", data, 96)[0])
        _number_at(
            data,
            rng.choice((start, start - 40, start - 46, start - 34, len(data) - 8)),
            rng.choice("HIQ"),
            rng,
        )
    else:
        _bytes(data, rng)
    return bytes(data)


def _of_e57(content: bytes, rng: random.Random) -> bytes:
    """Change numbers, words of the XML or bytes of the points, mostly with checksums that hold."""
    if len(content) < 2048 or rng.random() < 0.1:
        data = bytearray(content)
        _bytes(data, rng)
        return bytes(data)
    if rng.random() < 0.6:
        before, xml = split_xml(content)
        if xml:
            return with_xml(before, _in_xml(xml, rng))
    data = bytearray(without_checksums(content))
    if rng.random() < 0.4:
        _number_at(data, *rng.choice(_E57_NUMBERS), rng)
    else:
        _bytes(data, rng)
    return with_checksums(bytes(data))


def _in_xml(xml: bytes, rng: random.Random) -> bytes:
    """Put another number or word into the XML, or take a tag out of it, or say one twice."""
    which = rng.choice((rb"-?[0-9][0-9.e+-]*", rb"-?[0-9][0-9.e+-]*", rb"[A-Za-z0-9]+", rb"<[^<>]*>"))
    places = list(re.finditer(which, xml))
    if not places:
        return xml
    place = rng.choice(places)
    new = rng.choice(NUMBERS).encode() if rng.random() < 0.5 else rng.choice(_XML_WORDS)
    if rng.random() < 0.1:
        new = place[0] * 2
    return xml[: place.start()] + new + xml[place.end() :]


def _number_at(data: bytearray, at: int, kind: str, rng: random.Random) -> None:
    if not 0 <= at <= len(data) - struct.calcsize(kind):
        return
    if kind == "d":
        struct.pack_into("<d", data, at, rng.choice((*FLOATS, 0.001, 1e-12, -0.001, 1e300)))
        return
    now = int(struct.unpack_from(f"<{kind}", data, at)[0])
    words = [int(word) for word in NUMBERS if re.fullmatch("[0-9]+", word) and word.isascii()]
    value = now + rng.choice((-2, -1, 1, 2, 8)) if rng.random() < 0.4 else rng.choice(words)
    struct.pack_into(f"<{kind}", data, at, value & (1 << 8 * struct.calcsize(kind)) - 1)


def _bytes(data: bytearray, rng: random.Random) -> None:
    """Flip bits, replace, cut or lengthen."""
    match rng.randrange(5):
        case 0:
            del data[rng.randrange(len(data) + 1) :]
        case 1:
            data += bytes(rng.choice((1, 4, 1020, 1024)))
        case 2 if data:
            at = rng.randrange(len(data))
            data[at : at + rng.choice((1, 2, 4, 8))] = rng.randbytes(rng.choice((1, 2, 4, 8)))
        case _ if data:
            for _ in range(rng.choice((1, 1, 2, 8))):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
