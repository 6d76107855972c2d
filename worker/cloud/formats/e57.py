"""E57: a file of pages with checksums, which holds packed points and an XML that says where they lie and what they are.

Format: ASTM E2807-11; Huber, "The ASTM E57 file format for 3D imaging data exchange", 2011. The XML is read here first:
what it declares is held against the file before libE57Format (by pye57) decodes the points. Each scan of the file
(`Data3D`) was taken at one station; its points are in the station's frame, its pose leads to the file's.
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, ParseError  # nosec B405 - the types; defusedxml reads

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from worker.cloud.formats.fields import check_point_count
from worker.cloud.formats.store import ColumnStore
from worker.cloud.types import Matrix4
from worker.errors import ScanError, ScanTooLarge

MOST_STATIONS = 1000  #: of a file
_HEADER = struct.Struct(
    "<8sIIQQQQ"
)  #: signature, version, bytes of the file, where the XML lies, bytes of a page
_SECTION = struct.Struct("<B7xQQQ")  #: kind, bytes, where the first packet lies, where the index lies
_PAGE, _PAYLOAD = 1024, 1020  #: bytes of a page, and of those before its checksum
_XML_LIMIT = 16 * 1024**2  #: bytes; a station takes about 5 kB
_MOST_ELEMENTS, _DEEPEST = 500_000, 32
_AT_ONCE = 500_000  #: points decoded together
_FARTHEST = 1e8  #: metres that a pose may lie from the origin; coordinates on Earth are less
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")


@dataclass(frozen=True, kw_only=True, slots=True)
class Field:
    """One value of a point, as the prototype of the points has it."""

    kind: str  #: Integer, ScaledInteger or Float; empty: no number
    bits: int  #: that each point takes of the file
    low: float | None  #: least value that is declared
    high: float | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Station:
    """One scan of the file."""

    index: int  #: among all scans of the file
    name: str
    n: int  #: points
    pose: Matrix4 | None  #: (4, 4) file_from_station, rigid, metres; None where the file has none
    fields: dict[str, Field]
    color_limits: tuple[tuple[float, float], ...] | None  #: of red, green, blue; None: no colour is read
    refused: str = ""  #: why it cannot be read; what it declares is not known then

    @property
    def position(self) -> tuple[str, ...]:
        """The three fields that say where a point lies."""
        return _CARTESIAN if all(name in self.fields for name in _CARTESIAN) else _SPHERICAL

    @property
    def invalid_state(self) -> str:
        """The field that says whether a point lies there at all: 0 of those that do."""
        return "sphericalInvalidState" if self.position is _SPHERICAL else "cartesianInvalidState"


def looks_like_e57(head: bytes) -> bool:
    """Tell whether a file that starts with `head` means to be E57."""
    return head.startswith(b"ASTM-E57")


def read_stations(buffer: mmap.mmap) -> tuple[Station, ...]:
    """Return the scans of a file that hold points, each held against the file's size.

    One that cannot be what it declares is `refused`, for the others may be sound. Raises ScanError where none of them is.
    """
    root = _xml(buffer)
    data = _child(root, "data3D")
    children = list(data) if data is not None and data.get("type") == "Vector" else []
    if len(children) > MOST_STATIONS:
        raise ScanError(f"it holds {len(children)} scans, at most {MOST_STATIONS} are read; split the file")
    stations = [_station_or_refusal(child, index, buffer) for index, child in enumerate(children)]
    there = tuple(one for one in stations if one is not None and (one.n or one.refused))
    if not there:
        raise ScanError(f"no points are in it: it holds {len(children)} scans, all empty")
    if all(station.refused for station in there):
        raise ScanError(there[0].refused)
    return there


def read_e57(path: str, station: Station, store: ColumnStore, *, max_points: int) -> None:
    """Decode the points of one station into `store`, in its own frame; invalid ones are NaN.

    Raises ScanError, ScanTooLarge; whatever libE57Format does to a damaged file ends the process.
    """
    from pye57 import libe57  # noqa: PLC0415 - most scans are not E57

    if station.refused:
        raise ScanError(station.refused)
    check_point_count(station.n, max_points=max_points)
    store.allocate(station.n, colors=station.color_limits is not None)
    try:
        file = libe57.ImageFile(path, "r", libe57.CHECKSUM_POLICY_ALL)
        try:
            done = _decode(libe57, file, station, store)
        finally:
            file.close()
    except (libe57.E57Exception, RuntimeError, UnicodeError) as error:  # its words may be those of the file
        raise ScanError(f"its points are damaged ({_first_line(error)}); upload it again") from None
    if done != station.n:
        raise ScanError(f"truncated: {station.n} points are declared, file holds {done}; upload it again")
    store.finish_colors(255)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


def _decode(libe57: Any, file: Any, station: Station, store: ColumnStore) -> int:
    """Decode a piece at a time; return how many points there were."""
    wanted = [*station.position, *(_COLORS if station.color_limits else ())]
    invalid = [name for name in (station.invalid_state, "isColorInvalid") if name in station.fields]
    held: dict[str, NDArray[Any]] = {name: np.empty(_AT_ONCE, "d") for name in wanted}
    held |= {name: np.empty(_AT_ONCE, "b") for name in invalid}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in held.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, _AT_ONCE, True, True))
    scan = file.root()["data3D"][station.index]
    reader = scan["points"].reader(buffers)
    done = 0
    try:
        while count := int(reader.read()):
            if done + count > station.n:
                raise ScanError(f"more points follow than the {station.n} that are declared")
            piece = slice(done, done + count)
            _put(station, {name: array[:count] for name, array in held.items()}, store, piece)
            done += count
    finally:
        reader.close()
    return done


def _put(station: Station, held: dict[str, NDArray[Any]], store: ColumnStore, piece: slice) -> None:
    """Keep positions and colours of some points."""
    first, second, third = (held[name] for name in station.position)
    positions = (first, second, third)
    state = held.get(station.invalid_state)
    if station.position is _SPHERICAL:
        with np.errstate(invalid="ignore"):  # of an angle that is infinite
            flat = first * np.cos(third)
            positions = (flat * np.cos(second), flat * np.sin(second), first * np.sin(third))
    for name, values in zip("xyz", positions, strict=True):
        store.positions[name][piece] = values if state is None else np.where(state == 0, values, np.nan)
    unknown = held.get("isColorInvalid")
    for column, name, limits in zip(store.wide_colors, _COLORS, station.color_limits or (), strict=False):
        low, high = limits
        with np.errstate(invalid="ignore"):
            scaled = np.clip(np.nan_to_num((held[name] - low) / (high - low)), 0, 1)
        column[piece] = np.rint(255 * (scaled if unknown is None else np.where(unknown == 0, scaled, 0)))


def _xml(buffer: mmap.mmap) -> Element:
    """Return the root of the XML, which may have neither a document type nor entities. Raises ScanError."""
    if len(buffer) < _HEADER.size:
        raise ScanError(f"truncated: {len(buffer)} bytes, an E57 header takes {_HEADER.size}")
    _, major, minor, size, at, length, page = _HEADER.unpack_from(buffer)
    if major != 1 or page != _PAGE:
        raise ScanError(f"E57 version {major}.{minor} with pages of {page} bytes is not known")
    if size > len(buffer):
        raise ScanError(f"truncated: header declares {size} bytes, file holds {len(buffer)}; upload it again")
    if size < len(buffer) or size % _PAGE:
        raise ScanError(f"header declares {size} bytes, file holds {len(buffer)}; these are not its pages")
    if length > _XML_LIMIT:
        raise ScanTooLarge(f"its XML has {length} bytes, at most {_XML_LIMIT} are read; split the file")
    text = _logical(buffer, at, length)
    if b"\0" in text[:4] or text[:3] in (b"\xff\xfe", b"\xfe\xff"):
        raise ScanError("its XML is not UTF-8, as E57 has it")
    try:
        root: Element = fromstring(text, forbid_dtd=True, forbid_entities=True, forbid_external=True)
    except DefusedXmlException:
        raise ScanError("its XML declares a document type or entities, which no E57 needs") from None
    except (ParseError, ValueError, LookupError) as error:
        raise ScanError(f"its XML is damaged ({_first_line(error)}); upload it again") from None
    _check_shape(root)
    return root


def _logical(buffer: mmap.mmap, at: int, length: int) -> bytes:
    """Return `length` bytes from the place `at` on, without the checksums between. Raises ScanError."""
    pages = bytearray()
    if at % _PAGE >= _PAYLOAD or not _HEADER.size <= at < len(buffer):
        raise ScanError(f"it points at byte {at} of {len(buffer)}, where nothing can begin")
    while len(pages) < length:
        end = at - at % _PAGE + _PAYLOAD
        if end > len(buffer):
            raise ScanError(f"truncated: {length} bytes are declared, file holds {len(pages)} of them")
        pages += buffer[at:end]
        at = end + _PAGE - _PAYLOAD
    return bytes(pages[:length])


def _check_shape(root: Element) -> None:
    """Refuse an XML that is nested or long beyond reason: libE57Format makes an object of each element."""
    count = deepest = 0
    waiting: list[tuple[Iterator[Element], int]] = [(iter([root]), 1)]
    while waiting:
        children, depth = waiting[-1]
        child = next(children, None)
        if child is None:
            waiting.pop()
            continue
        count, deepest = count + 1, max(deepest, depth)
        if count > _MOST_ELEMENTS or deepest > _DEEPEST:
            raise ScanError(
                f"its XML has over {_MOST_ELEMENTS} elements, or is nested deeper than {_DEEPEST}; split the file"
            )
        waiting.append((iter(child), depth + 1))


def _child(parent: Element | None, name: str) -> Element | None:
    """Return the child of that name in the namespace of E57."""
    if parent is None:
        return None
    space = parent.tag.rpartition("}")[0]
    return parent.find(f"{space}}}{name}" if space else name)


def _station_or_refusal(scan: Element, index: int, buffer: mmap.mmap) -> Station | None:
    """Read one scan, or why that cannot be; None where it has no points."""
    try:
        return _station(scan, index, buffer)
    except ScanError as error:
        return Station(
            index=index,
            name=_name(scan),
            n=0,
            pose=None,
            fields={},
            color_limits=None,
            refused=str(error),
        )


def _name(scan: Element) -> str:
    return "".join(letter for letter in (_text(scan, "name") or "") if letter.isprintable())[:100]


def _station(scan: Element, index: int, buffer: mmap.mmap) -> Station | None:
    """Read one scan; None where it has no points."""
    points = _child(scan, "points")
    if points is None:
        return None
    if (scan.get("type"), points.get("type")) != ("Structure", "CompressedVector"):
        raise ScanError(f"scan {index + 1} is a {scan.get('type')!r} with points of {points.get('type')!r}")
    n = _count(points, "recordCount")
    prototype = _child(points, "prototype")
    fields = {
        child.tag.rpartition("}")[2]: _field(child) for child in (prototype if prototype is not None else ())
    }
    station = Station(
        index=index,
        name=_name(scan),
        n=n,
        pose=_pose(_child(scan, "pose")),
        fields=fields,
        color_limits=_color_limits(scan, fields),
    )
    missing = [name for name in station.position if name not in fields or not fields[name].kind]
    if missing and n:
        raise ScanError(f"scan {index + 1} has no {missing[0]}: its points have no position")
    if n:
        _check_section(station, _count(points, "fileOffset"), buffer)
    return station


def _count(element: Element, name: str) -> int:
    word = element.get(name, "")
    if not (word.isascii() and word.isdigit() and len(word) <= 18):
        raise ScanError(f"{name} {word[:40]!r} is not a whole number")
    return int(word)


def _text(parent: Element | None, name: str) -> str | None:
    child = _child(parent, name)
    return None if child is None else (child.text or "").strip()


def _number(parent: Element | None, name: str, default: float | None = None) -> float | None:
    """Return the value of a child; an empty one is 0, one that is not there the default. Raises ScanError."""
    child = _child(parent, name)
    if child is None:
        return default
    value = _float(child.text or "0", name)
    if child.get("type") == "ScaledInteger":
        value = value * _float(child.get("scale", "1"), name) + _float(child.get("offset", "0"), name)
    return value


def _float(word: str, name: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ScanError(f"{name} {word[:40]!r} is not a number")
    return value


def _field(element: Element) -> Field:
    """Read one entry of the prototype."""
    kind, name = element.get("type", ""), element.tag.rpartition("}")[2][:40]
    if kind == "Float":
        double = element.get("precision", "double") != "single"
        low, high = (_bound(element, which, name) for which in ("minimum", "maximum"))
        return Field(kind=kind, bits=64 if double else 32, low=low, high=high)
    if kind in ("Integer", "ScaledInteger"):
        least, most = (_whole(element, which, name) for which in ("minimum", "maximum"))
        least, most = -(2**63) if least is None else least, 2**63 - 1 if most is None else most
        if least > most:
            raise ScanError(f"field {name!r} has a minimum over its maximum")
        scale, offset = _float(element.get("scale", "1"), name), _float(element.get("offset", "0"), name)
        if scale == 0:
            raise ScanError(f"field {name!r} has scale 0")
        low, high = sorted((least * scale + offset, most * scale + offset))
        return Field(kind=kind, bits=(most - least).bit_length(), low=low, high=high)
    return Field(kind="", bits=0, low=None, high=None)


def _bound(element: Element, which: str, name: str) -> float | None:
    word = element.get(which)
    return None if word is None else _float(word, f"{which} of {name}")


def _whole(element: Element, which: str, name: str) -> int | None:
    word = element.get(which)
    if word is None:
        return None
    digits = word.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 19) or not -(2**63) <= int(word) < 2**63:
        raise ScanError(f"{which} {word[:40]!r} of {name} is not a whole number of 64 bits")
    return int(word)


def _check_section(station: Station, at: int, buffer: mmap.mmap) -> None:
    """Hold the points that are declared against the bytes that they lie in."""
    kind, length, *_ = _SECTION.unpack(_logical(buffer, at, _SECTION.size))
    pages = (len(buffer) - at) // _PAGE + 1
    if kind != 1 or length > pages * _PAYLOAD:
        raise ScanError(
            f"truncated: the points of scan {station.index + 1} take {length} bytes from byte {at} on, the file ends "
            f"at {len(buffer)}; upload it again"
        )
    bits = sum(field.bits for field in station.fields.values())
    if not any(station.fields[name].bits for name in station.position):
        raise ScanError(f"all points of scan {station.index + 1} are declared to lie at one place")
    if bits * station.n > 8 * length:
        raise ScanError(
            f"truncated: scan {station.index + 1} declares {station.n} points of {bits} bits in {length} bytes; "
            "upload it again"
        )


def _pose(element: Element | None) -> Matrix4 | None:
    """Return file_from_station (4, 4). Raises ScanError for what is none."""
    if element is None:
        return None
    rotation, translation = _child(element, "rotation"), _child(element, "translation")
    w = _number(rotation, "w", 1.0)
    x, y, z = (_number(rotation, name, 0.0) for name in "xyz")
    quaternion = np.array([x, y, z, w], np.float64)
    place = np.array([_number(translation, name, 0.0) for name in "xyz"], np.float64)
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > 0.05:
        raise ScanError(f"a pose has a quaternion of length {length:.3g}, not 1")
    if float(np.abs(place).max()) > _FARTHEST:
        raise ScanError(f"a pose lies {np.abs(place).max():.3g} m from the origin, which is nowhere on Earth")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = place
    return pose


def _color_limits(scan: Element, fields: dict[str, Field]) -> tuple[tuple[float, float], ...] | None:
    """Return what is black and what is full of each colour: as declared of the scan, else of the field, else by kind."""
    if not all(name in fields and fields[name].kind for name in _COLORS):
        return None
    told = _child(scan, "colorLimits")
    limits = []
    for name in _COLORS:
        field = fields[name]
        usual = (0.0, 1.0) if field.kind == "Float" else (0.0, 255.0)
        wide = field.bits > 32 or field.low is None or field.high is None
        low, high = usual if wide else (field.low, field.high)
        low, high = _number(told, f"{name}Minimum", low), _number(told, f"{name}Maximum", high)
        if low is None or high is None or not low < high:
            return None
        limits.append((low, high))
    return tuple(limits)
