"""Boxes that requests name (`bbox`, `bbox-crs`), and the frames that coordinates are in (`crs`).

Names and defaults are those of OGC API - Features - Part 2 (OGC 18-058r1): without `bbox-crs` a box is in WGS 84. A map
that lies nowhere on the Earth has its own frame alone, so there it is that.
"""

from __future__ import annotations

import itertools
import math
import sys
from typing import Literal

from fastapi.exceptions import RequestValidationError

from service.api.gis.geodesy import from_wgs84
from service.catalog.records import Anchor, Bounds, Vector3
from service.tile_features import MAP_FRAME

CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"  #: longitude, latitude (degrees)
CRS84H = "http://www.opengis.net/def/crs/OGC/0/CRS84h"  #: and the height above the ellipsoid (metres)
#: How a request names a frame: in short, or by its URI.
Crs = Literal[
    "map",
    "CRS84",
    "CRS84h",
    "http://www.opengis.net/def/crs/OGC/0/Engineering3D",
    "http://www.opengis.net/def/crs/OGC/1.3/CRS84",
    "http://www.opengis.net/def/crs/OGC/0/CRS84h",
]

_REACH = 0.3  #: degrees of a great circle around the anchor; a map reaches 10 km, which is a third of that
_STEEP = (
    85.0  #: degrees of latitude; nearer to a pole meridians run together, and a box is not cut to the map
)
_STEPS = 16  #: pieces of each side of a box, whose corners are turned into the map's frame
_UP_AND_DOWN = 10_000.0  #: metres that a map reaches above and below its origin
_MOST = 10_001.0  #: metres that a map reaches along each axis
_EVERYWHERE = sys.float_info.max
_NOWHERE = Bounds(min=(_EVERYWHERE,) * 3, max=(_EVERYWHERE,) * 3)


def is_map_frame(crs: Crs | None) -> bool:
    """Tell whether a name of a frame is that of the map's own."""
    return crs in ("map", MAP_FRAME)


def numbers_of(bbox: str) -> tuple[float, ...]:
    """Read four numbers (two axes) or six (three): the minimum corner, then the maximum. Raises ValueError."""
    try:
        numbers = tuple(float(part) for part in bbox.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (4, 6) or not all(math.isfinite(number) for number in numbers):
        raise ValueError(
            "give four or six numbers: minimum x,y[,z] then maximum x,y[,z], in metres of the map frame or longitude, "
            "latitude and height"
        )
    return numbers


def bounds_of(bbox: str | None, crs: Crs | None, anchor: Anchor | None) -> Bounds | None:
    """Return the box in the frame of a map that lies at `anchor`, metres; None where none is asked for.

    A box in WGS 84 becomes the smallest one along the map's axes that surely holds it: on a map that is turned against
    the meridian it takes in somewhat more. Raises RequestValidationError for a box that ends before it begins or lies off the Earth,
    and for one in WGS 84 on a map without an anchor.
    """
    if bbox is None:
        return None
    numbers = numbers_of(bbox)
    if is_map_frame(crs) or (crs is None and anchor is None):
        return _in_map(numbers, bbox)
    if anchor is None:
        raise _wrong(
            f"{crs} is on the Earth, and nobody said where this map lies there; give the box in metres with "
            "bbox-crs=map, or put an anchor",
            crs,
            name="bbox-crs",
        )
    return _from_earth(numbers, anchor, bbox)


def _in_map(numbers: tuple[float, ...], bbox: str) -> Bounds:
    half = len(numbers) // 2
    low, high = list(numbers[:half]), list(numbers[half:])
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise _wrong("the minimum corner comes first, then the maximum", bbox)
    if half == 2:
        low, high = [*low, -_EVERYWHERE], [*high, _EVERYWHERE]
    return Bounds(min=(low[0], low[1], low[2]), max=(high[0], high[1], high[2]))


def _from_earth(numbers: tuple[float, ...], anchor: Anchor, bbox: str) -> Bounds:
    """Return the box of the map's frame that holds one of longitudes, latitudes and perhaps heights."""
    half = len(numbers) // 2
    (west, south, *bottom), (east, north, *top) = numbers[:half], numbers[half:]
    if not (-90 <= south <= north <= 90 and -180 <= west <= 180 and -180 <= east <= 180):
        raise _wrong(
            "longitudes are from -180 to 180 and latitudes from -90 to 90 degrees, the southern first; boxes in metres "
            "of the map's frame have bbox-crs=map",
            bbox,
        )
    if bottom and bottom[0] > top[0]:
        raise _wrong("the lower height comes first", bbox)
    south, north = max(south, anchor.latitude - _REACH), min(north, anchor.latitude + _REACH)
    if south > north:
        return _NOWHERE
    heights = (bottom[0], top[0]) if bottom else None
    if abs(anchor.latitude) > _STEEP:
        return _tall(Bounds(min=(-_EVERYWHERE,) * 3, max=(_EVERYWHERE,) * 3), heights, anchor)
    span = _near(west, east, anchor)
    if span is None:
        return _NOWHERE
    return _tall(_held(span, (south, north), anchor), heights, anchor)


def _near(west: float, east: float, anchor: Anchor) -> tuple[float, float] | None:
    """Return the part of the longitudes from `west` eastward to `east` that is near the anchor, as differences from its own.

    None where there is no such part. From a larger number to a smaller one crosses the antimeridian (RFC 7946,
    Section 5.2).
    """
    width = east - west if east >= west else east - west + 360
    start = (west - anchor.longitude) % 360
    reach = _REACH / math.cos(math.radians(min(abs(anchor.latitude) + _REACH, 89)))
    parts = [
        (max(start + turn, -reach), min(start + turn + width, reach))
        for turn in (-360, 0)  # the second begins beside the anchor's meridian or east of it
    ]
    near = [(first, last) for first, last in parts if first <= last]
    return (min(first for first, _ in near), max(last for _, last in near)) if near else None


def _held(span: tuple[float, float], latitudes: tuple[float, float], anchor: Anchor) -> Bounds:
    """Return the box, without limits of height, that holds this piece of the Earth at any height of a map.

    The sides are curves in the map's frame, so they are looked at in pieces, and the box is larger by more than a
    piece can bulge: s^2 / 8r, with a parallel's radius of curvature r of at least 500 km up to 85 degrees.
    """
    (west, east), (south, north) = span, latitudes
    convert = from_wgs84(anchor)
    shares = [step / _STEPS for step in range(_STEPS + 1)]
    along = [west + share * (east - west) for share in shares]
    across = [south + share * (north - south) for share in shares]
    edge = [(lon, lat) for lon in along for lat in (south, north)]
    edge += [(lon, lat) for lat in across for lon in (west, east)]
    heights = (anchor.height - _UP_AND_DOWN, anchor.height + _UP_AND_DOWN)
    corners: list[Vector3] = [
        convert((anchor.longitude + lon, lat, height))
        for (lon, lat), height in itertools.product(edge, heights)
    ]
    xs, ys, _ = zip(*corners, strict=True)
    piece = max(max(xs) - min(xs), max(ys) - min(ys)) * math.sqrt(2) / _STEPS
    margin = 0.001 + piece**2 / (8 * 500_000)
    return Bounds(
        min=(min(xs) - margin, min(ys) - margin, -_EVERYWHERE),
        max=(max(xs) + margin, max(ys) + margin, _EVERYWHERE),
    )


def _tall(box: Bounds, heights: tuple[float, float] | None, anchor: Anchor) -> Bounds:
    """Return a box with limits of height, metres above the ellipsoid; the Earth falls off by d^2 / 2r (16 m at 14 km)."""
    if heights is None:
        return box
    low, high = (height - anchor.height for height in heights)
    (x0, y0, _), (x1, y1, _) = box.min, box.max
    far = max(min(abs(side), _MOST) for side in (x0, x1)), max(min(abs(side), _MOST) for side in (y0, y1))
    fall = 0.01 + (far[0] ** 2 + far[1] ** 2) / (2 * 6_300_000)
    return Bounds(min=(x0, y0, low - fall), max=(x1, y1, high + 0.01))


def _wrong(why: str, given: str | None, *, name: str = "bbox") -> RequestValidationError:
    return RequestValidationError(
        [{"type": "value_error", "loc": ("query", name), "msg": why, "input": given}]
    )
