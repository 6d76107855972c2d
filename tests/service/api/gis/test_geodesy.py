"""From a map's frame to WGS 84, against published values and by a way back that is written apart."""

from __future__ import annotations

from math import cos, degrees, hypot, radians, sin, sqrt

import pytest

from service.api.gis.geodesy import to_ecef, to_wgs84
from service.catalog.records import Anchor

X_EAST = 90.0  #: the heading that makes x east and y north


def anchor(longitude: float, latitude: float, height: float = 0.0, heading: float = X_EAST) -> Anchor:
    return Anchor(longitude=longitude, latitude=latitude, height=height, heading=heading)


def back(at: Anchor, found: tuple[float, float, float]) -> tuple[float, float, float]:
    """East, north, up of a position, metres: the textbook's rotation, row by row."""
    lon, lat = radians(at.longitude), radians(at.latitude)
    here, origin = (
        to_ecef(radians(lon), radians(lat), height)
        for lon, lat, height in (found, (at.longitude, at.latitude, at.height))
    )
    dx, dy, dz = (a - b for a, b in zip(here, origin, strict=True))
    return (
        -sin(lon) * dx + cos(lon) * dy,
        -sin(lat) * cos(lon) * dx - sin(lat) * sin(lon) * dy + cos(lat) * dz,
        cos(lat) * cos(lon) * dx + cos(lat) * sin(lon) * dy + sin(lat) * dz,
    )


def test_the_matterhorn_from_zermatt_as_mathworks_documents_it() -> None:
    """MathWorks, geodetic2enu: five digits of east, north and up for a point given in degrees and metres."""
    longitude, latitude, height = to_wgs84(anchor(7.750, 46.017, 1673))((-7134.8, -4556.3, 2852.4))
    assert (longitude, latitude) == pytest.approx((7.658, 45.976), abs=1e-6)
    assert height == pytest.approx(4531, abs=0.05)


def test_a_point_1_km_away_as_pymap3d_tests_it() -> None:
    """The values of pymap3d and matmap3d (Michael Hirsch) for 33 degrees azimuth, 70 elevation, 1 km."""
    longitude, latitude, height = to_wgs84(anchor(-82, 42, 200))((186.277521, 286.842228, 939.692621))
    assert (longitude, latitude) == pytest.approx((-81.997752, 42.002582), abs=1e-6)
    assert height == pytest.approx(1139.7018, abs=1e-3)
    assert to_ecef(radians(-82), radians(42), 200) == pytest.approx(
        (660675.2518, -4700948.6832, 4245737.6622), abs=1e-3
    )


def test_100_m_east_at_60_degrees_north_are_100_m_of_that_parallel() -> None:
    longitude, latitude, height = to_wgs84(anchor(10, 60))((100, 0, 0))
    radius = cos(radians(60)) * 6378137 / sqrt(1 - 0.00669437999014 * sin(radians(60)) ** 2)
    assert longitude - 10 == pytest.approx(degrees(100 / radius), rel=1e-6)
    assert latitude == pytest.approx(60, abs=1e-7)
    assert height == pytest.approx(100**2 / 2 / 6.39e6, rel=0.01)  # the plane leaves the curved Earth


@pytest.mark.parametrize(
    ("heading", "x_points", "y_points"),
    [(0, (0, 1), (-1, 0)), (90, (1, 0), (0, 1)), (180, (0, -1), (1, 0)), (270, (-1, 0), (0, -1))],
)
def test_the_heading_is_the_bearing_of_x_and_y_lies_to_its_left(
    heading: float, x_points: str, y_points: str
) -> None:
    at = anchor(13.4, 52.5, 80, heading)
    for point, expected in (((10, 0, 0), x_points), ((0, 10, 0), y_points)):
        east, north, _ = back(at, to_wgs84(at)(point))
        assert (east / 10, north / 10) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("latitude", [-89.9, -33.9, 0, 1e-9, 52.5, 90])
@pytest.mark.parametrize("longitude", [-180, -70.7, 0, 179.99999, 180])
def test_there_and_back_again_is_within_a_tenth_of_a_millimetre(longitude: float, latitude: float) -> None:
    at = anchor(longitude, latitude, 9000)
    for point in ((0, 0, 0), (0.5, -0.25, 3), (-2000, 1500, -900), (9000, 9000, 50)):
        found = back(at, to_wgs84(at)(point))
        assert hypot(*(a - b for a, b in zip(found, point, strict=True))) < 1e-4


def test_longitudes_on_the_antimeridian_are_not_torn_apart() -> None:
    at = anchor(179.99999, -17)
    west, east = (to_wgs84(at)((x, 0, 0))[0] for x in (-5, 5))
    assert west < 180 < east < west + 1e-3
