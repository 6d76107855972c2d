"""From a map's frame to WGS 84: a tangent plane at the map's origin, through Earth-centred coordinates, exactly.

The ellipsoid is that of NIMA TR8350.2 (WGS 84); from Earth-centred to geodetic by the usual fixed point
(Hofmann-Wellenhof and Moritz, Physical Geodesy), with a height that stays well defined at the poles. See
docs/decisions/0011.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from service.catalog.records import Anchor, Vector3

_SEMI_MAJOR = 6_378_137.0  #: metres
_FLATTENING = 1 / 298.257223563
_E2 = _FLATTENING * (2 - _FLATTENING)  #: first eccentricity, squared
_ROUNDS = 6  #: of the fixed point; each divides the error by 100 or more, and the first guess is exact on the ellipsoid

ToWgs84 = Callable[
    [Vector3], Vector3
]  #: map frame (metres) to longitude, latitude (degrees), height (metres)
FromWgs84 = Callable[[Vector3], Vector3]  #: and back


def to_wgs84(anchor: Anchor) -> ToWgs84:
    """Return the function from the frame of a map that lies at `anchor` to WGS 84; the height is above the ellipsoid.

    The longitude stays within half a turn of the anchor's, so that a footprint on the antimeridian is not torn apart.
    """
    longitude, latitude, heading = (
        math.radians(angle) for angle in (anchor.longitude, anchor.latitude, anchor.heading)
    )
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_h, cos_h = math.sin(heading), math.cos(heading)
    x0, y0, z0 = to_ecef(longitude, latitude, anchor.height)

    def convert(point: Vector3) -> Vector3:
        x, y, up = point
        east, north = x * sin_h - y * cos_h, x * cos_h + y * sin_h
        out = cos_lat * up - sin_lat * north  # away from the Earth's axis, in the anchor's meridian
        lon, lat, height = to_geodetic(
            x0 + cos_lon * out - sin_lon * east,
            y0 + sin_lon * out + cos_lon * east,
            z0 + cos_lat * north + sin_lat * up,
        )
        turned = math.degrees(math.remainder(lon - longitude, math.tau))
        return anchor.longitude + turned, math.degrees(lat), height

    return convert


def from_wgs84(anchor: Anchor) -> FromWgs84:
    """Return the function from WGS 84 to the frame of a map that lies at `anchor`, the inverse of `to_wgs84`."""
    longitude, latitude, heading = (
        math.radians(angle) for angle in (anchor.longitude, anchor.latitude, anchor.heading)
    )
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_h, cos_h = math.sin(heading), math.cos(heading)
    x0, y0, z0 = to_ecef(longitude, latitude, anchor.height)

    def convert(point: Vector3) -> Vector3:
        lon, lat, height = point
        x, y, z = to_ecef(math.radians(lon), math.radians(lat), height)
        dx, dy, dz = x - x0, y - y0, z - z0
        out = cos_lon * dx + sin_lon * dy
        east, north = cos_lon * dy - sin_lon * dx, cos_lat * dz - sin_lat * out
        return east * sin_h + north * cos_h, north * sin_h - east * cos_h, cos_lat * out + sin_lat * dz

    return convert


def ecef_from_map(anchor: Anchor) -> list[float]:
    """Return the transform (4, 4) from the frame of a map to Earth-centred coordinates (EPSG:4978), column by column."""
    longitude, latitude, heading = (
        math.radians(angle) for angle in (anchor.longitude, anchor.latitude, anchor.heading)
    )
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_h, cos_h = math.sin(heading), math.cos(heading)
    east = (-sin_lon, cos_lon, 0.0)
    north = (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat)
    up = (cos_lat * cos_lon, cos_lat * sin_lon, sin_lat)
    x = (e * sin_h + n * cos_h for e, n in zip(east, north, strict=True))
    y = (n * sin_h - e * cos_h for e, n in zip(east, north, strict=True))
    return [*x, 0.0, *y, 0.0, *up, 0.0, *to_ecef(longitude, latitude, anchor.height), 1.0]


def to_ecef(longitude: float, latitude: float, height: float) -> Vector3:
    """Return Earth-centred, Earth-fixed x, y, z (metres) of a geodetic position (radians, metres)."""
    normal = _normal(latitude)
    out = (normal + height) * math.cos(latitude)
    along = (normal * (1 - _E2) + height) * math.sin(latitude)
    return out * math.cos(longitude), out * math.sin(longitude), along


def to_geodetic(x: float, y: float, z: float) -> Vector3:
    """Return longitude, latitude (radians) and height (metres) of an Earth-centred position near the surface."""
    out = math.hypot(x, y)
    latitude = math.atan2(z, out * (1 - _E2))
    for _ in range(_ROUNDS):
        latitude = math.atan2(z + _E2 * _normal(latitude) * math.sin(latitude), out)
    normal = _normal(latitude)
    height = out * math.cos(latitude) + z * math.sin(latitude) - _SEMI_MAJOR**2 / normal
    return math.atan2(y, x), latitude, height


def _normal(latitude: float) -> float:
    """Return the radius of curvature in the prime vertical, metres."""
    return _SEMI_MAJOR / math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
