"""Small sound PLY and PCD files in every encoding, and what may be wrong with a file, by its structure."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass

import imagecodecs
import numpy as np

N = 12  #: points of a sound file
NUMBERS = (
    "0", "1", "2", "3", "4", "5", "8", "11", "12", "13", "16", "24", "255", "256", "1000", "65535", "65536", "65537",
    "1000000", "5000001", "50000000", "50000001", "2147483647", "2147483648", "4294967295", "4294967296",
    "999999999999999999", "1000000000000000000", "18446744073709551616", "-1", "-0", "+1", "1.0", "1e3", "0x10", "٣",
)  # fmt: skip
WORDS = (
    "x", "y", "z", "rgb", "rgba", "red", "green", "blue", "r", "g", "b", "_", "float", "double", "uchar", "int", "int8",
    "list", "vertex", "face", "element", "property", "comment", "obj_info", "format", "ascii", "binary", "1.0", "0.7",
    ".5", "binary_little_endian", "binary_big_endian", "binary_compressed", "end_header", "ply", "DATA", "FIELDS",
    "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "POINTS", "VIEWPOINT", "VERSION", "F", "I", "U", "#", "nan", "", " ",
    "\t", "\r", "\0", "é" * 40, "A" * 3000,
)  # fmt: skip
VALUES = (
    "nan", "inf", "-inf", "1e39", "-1e39", "1e400", "1e-400", "9999.99", "10000.1", "0x1p3", "1_0", "١", "", "-",
    "--1", "1e", "1d3", "1,5", "256", "-1", "1.5", "4294967296", "#", "\0", "nan(1)", "1j", "9" * 400,
)  # fmt: skip
FLOATS = (
    np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, 3.4e38, -3.4e38, 9999.0, 10001.0, 1e6, 600.0, 1.0, 255.0, 0.5,
)  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """A sound file in its two parts."""

    name: str
    lines: tuple[bytes, ...]  #: of the header, the last one included
    body: bytes
    plain: bytes | None = None  #: the body before LZF

    def joined(self, end: bytes = b"\n") -> bytes:
        """Return the file."""
        return end.join((*self.lines, b"")) + self.body


def samples() -> list[Sample]:
    """Return a sound file of every encoding and layout that is read."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (N, 3))
    points[3, 1] = np.nan
    made = [_ply(encoding, layout, points) for encoding in ("ascii", "<", ">") for layout in _PLY_LAYOUTS]
    encodings = ("ascii", "binary", "binary_compressed")
    return made + [_pcd(encoding, layout, points) for encoding in encodings for layout in _PCD_LAYOUTS]


_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "u2": "ushort"}
_XYZ = (("x", "f4"), ("y", "f4"), ("z", "f4"))
_RGB = (("red", "u1"), ("green", "u1"), ("blue", "u1"))
#: properties of a vertex, and whether lists stand before and after it
_PLY_LAYOUTS: tuple[tuple[tuple[tuple[str, str], ...], bool, bool], ...] = (
    (_XYZ, False, False),
    (_XYZ + _RGB, False, True),
    ((*((name, "f8") for name in "xyz"), ("quality", "i4")), True, False),
    ((("q", "u2"), *_XYZ, ("r", "f4"), ("g", "f4"), ("b", "f4")), True, True),
)
#: fields with their counts
_PCD_LAYOUTS: tuple[tuple[tuple[str, str, int], ...], ...] = (
    tuple((name, kind, 1) for name, kind in _XYZ),
    (*((name, kind, 1) for name, kind in _XYZ), ("rgb", "f4", 1)),
    (("_", "u1", 3), ("z", "f8", 1), ("x", "f4", 1), ("y", "f4", 1), ("normal", "f4", 3)),
    (*((name, "f8", 1) for name in "xyz"), ("rgba", "u4", 1), ("label", "i8", 1)),
)


def _rows(dtype: np.dtype, points: np.ndarray) -> np.ndarray:
    rows = np.zeros(N, dtype)
    for name in dtype.names or ():
        if name in ("x", "y", "z"):
            rows[name] = points[:, "xyz".index(name)]
        elif name in ("r", "g", "b"):
            rows[name] = np.linspace(0, 1, N)
        elif name != "rgb":
            rows[name] = np.arange(N).reshape(N, *[1] * (rows[name].ndim - 1))
    return rows


def _text(rows: np.ndarray) -> bytes:
    lines = [" ".join(f"{v:g}" for value in row for v in np.ravel(value)) for row in rows]
    return ("\n".join(lines) + "\n").encode()


def _ply(encoding: str, layout: tuple[tuple[tuple[str, str], ...], bool, bool], points: np.ndarray) -> Sample:
    properties, before, after = layout
    order = "<" if encoding == "ascii" else encoding
    word = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[encoding]
    rows = _rows(np.dtype([(name, order + kind) for name, kind in properties]), points)
    lists = ["property list uchar int v", "property float weight"]
    lines = ["ply", f"format {word} 1.0", "comment sound"]
    lines += ["element face 2", *lists] if before else []
    lines += [f"element vertex {N}", *(f"property {_NAMES[kind]} {name}" for name, kind in properties)]
    lines += ["element edge 2", *lists] if after else []
    listed = struct.pack(f"{order}BiifBf", 2, 0, 1, 0.5, 0, 1.5)
    text = b"2 0 1 0.5\n0 1.5\n"
    other = text if encoding == "ascii" else listed
    body = (other if before else b"") + (_text(rows) if encoding == "ascii" else rows.tobytes())
    body += other if after else b""
    header = tuple(line.encode() for line in (*lines, "end_header"))
    return Sample(f"ply {word} {len(properties)}", header, body)


def _pcd(encoding: str, layout: tuple[tuple[str, str, int], ...], points: np.ndarray) -> Sample:
    rows = _rows(np.dtype([(name, "<" + kind, (count,)) for name, kind, count in layout]), _tripled(points))
    lines = ["# .PCD v0.7", "VERSION 0.7", "FIELDS " + " ".join(name for name, _, _ in layout)]
    lines += ["SIZE " + " ".join(kind[1] for _, kind, _ in layout)]
    lines += ["TYPE " + " ".join(kind[0].upper() for _, kind, _ in layout)]
    lines += ["COUNT " + " ".join(str(count) for _, _, count in layout)]
    lines += [f"WIDTH {N // 2}", "HEIGHT 2", "VIEWPOINT 0.5 0 1 1 0 0 0", f"POINTS {N}", f"DATA {encoding}"]
    header = tuple(line.encode() for line in lines)
    name = f"pcd {encoding} {len(layout)}"
    if encoding == "ascii":
        return Sample(name, header, _text(rows))
    if encoding == "binary":
        return Sample(name, header, rows.tobytes())
    plain = b"".join(rows[field].tobytes() for field, _, _ in layout)
    return Sample(name, header, lzf(plain), plain)


def _tripled(points: np.ndarray) -> np.ndarray:
    return points[:, :, None]


def lzf(plain: bytes) -> bytes:
    """Return an LZF block with its two sizes before it."""
    try:
        packed = imagecodecs.lzf_encode(plain)
    except imagecodecs.LzfError:  # too short to be packed: runs of bytes as they are
        packed = b"".join(
            bytes([len(run) - 1]) + run for run in (plain[at : at + 32] for at in range(0, len(plain), 32))
        )
    return struct.pack("<II", len(packed), len(plain)) + packed


def mutated(sample: Sample, rng: random.Random) -> bytes:
    """Return the file with one to four things wrong with it, or none."""
    lines, body, plain = list(sample.lines), bytearray(sample.body), sample.plain
    for _ in range(rng.choice((0, 1, 1, 1, 2, 2, 3, 4))):
        if lines and rng.random() < 0.5:
            rng.choice(_HEADER)(lines, rng)
        elif plain and rng.random() < 0.4:
            changed = bytearray(plain)
            rng.choice(_BYTES)(changed, rng)
            body = bytearray(lzf(bytes(changed)))
        elif sample.name.startswith(("ply ascii", "pcd ascii")) and rng.random() < 0.6:
            _word_in_text(body, rng)
        else:
            rng.choice(_BYTES)(body, rng)
    end = b"\r\n" if rng.random() < 0.03 else b"\n"
    content = end.join((*lines, b"")) + bytes(body)
    return content[: rng.randrange(len(content) + 1)] if rng.random() < 0.03 else content


def _word(lines: list[bytes], rng: random.Random) -> None:
    """Put another word into a line, or take one out of it, or add one."""
    at = rng.randrange(len(lines))
    words = lines[at].split(b" ")
    new = rng.choice(WORDS if rng.random() < 0.6 else NUMBERS).encode()
    place = rng.randrange(len(words))
    match rng.randrange(4):
        case 0:
            del words[place]
        case 1:
            words.insert(place, new)
        case _:
            words[place] = new
    lines[at] = b" ".join(words)


def _number(lines: list[bytes], rng: random.Random) -> None:
    """Put another number where one stands."""
    places = [
        (i, j) for i, line in enumerate(lines) for j, word in enumerate(line.split(b" ")) if word.isdigit()
    ]
    if places:
        at, place = rng.choice(places)
        words = lines[at].split(b" ")
        near = str(max(0, int(words[place]) + rng.choice((-2, -1, 1, 2))))
        words[place] = (near if rng.random() < 0.4 else rng.choice(NUMBERS)).encode()
        lines[at] = b" ".join(words)


def _line(lines: list[bytes], rng: random.Random) -> None:
    """Take a line out, say it twice, move it, or make it very long."""
    at = rng.randrange(len(lines))
    match rng.randrange(5):
        case 0:
            del lines[at]
        case 1:
            lines.insert(rng.randrange(len(lines) + 1), lines[at])
        case 2:
            lines.insert(rng.randrange(len(lines)), lines.pop(at))
        case 3:
            lines[at] += b" 1" * rng.choice((3, 300, 3000))
        case _:
            lines.insert(at, rng.choice(WORDS).encode())


def _flip(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 2, 8))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _replace(data: bytearray, rng: random.Random) -> None:
    if data:
        at = rng.randrange(len(data))
        data[at : at + rng.choice((1, 1, 2, 4, 8))] = rng.randbytes(rng.choice((0, 1, 2, 4, 8)))


def _cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data) + 1) :]


def _lengthen(data: bytearray, rng: random.Random) -> None:
    count = rng.choice((1, 4, 12, 100, 4096))
    data += bytes(count) if rng.random() < 0.5 else rng.randbytes(count)


def _float(data: bytearray, rng: random.Random) -> None:
    """Put an odd float or double, of either byte order, at a place that is a multiple of four."""
    code = rng.choice(("<f", ">f", "<d", ">d"))
    if len(data) >= 8:
        at = 4 * rng.randrange(len(data) // 4 - 1)
        value = rng.choice(FLOATS)
        data[at : at + struct.calcsize(code)] = struct.pack(code, value)


def _count(data: bytearray, rng: random.Random) -> None:
    """Put an odd length at the beginning, where sizes and lists' lengths stand."""
    value = int(rng.choice(NUMBERS[:25])) & 0xFFFFFFFF
    at = rng.choice((0, 4))
    data[at : at + 4] = struct.pack(rng.choice("<>") + "I", value)


def _word_in_text(data: bytearray, rng: random.Random) -> None:
    """Put another value where one stands in text, or break the line."""
    words = bytes(data).split(b" ")
    words[rng.randrange(len(words))] = rng.choice((*VALUES, "\n", "\n\n", "1 1")).encode()
    data[:] = b" ".join(words)


Header = Callable[[list[bytes], random.Random], None]
Bytes = Callable[[bytearray, random.Random], None]
_HEADER: tuple[Header, ...] = (_word, _number, _number, _line)
_BYTES: tuple[Bytes, ...] = (_flip, _replace, _cut, _lengthen, _float, _float, _count)
