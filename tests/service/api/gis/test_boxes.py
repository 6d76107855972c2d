"""Boxes of requests, on maps that lie on the Earth and on others."""

from __future__ import annotations

import random
import sys

import pytest
from fastapi.exceptions import RequestValidationError

from service.api.gis.boxes import CRS84, CRS84H, bounds_of, numbers_of
from service.api.gis.geodesy import to_wgs84
from service.catalog.records import Anchor, Bounds, Vector3
from service.tile_features import MAP_FRAME

BERLIN = Anchor(longitude=13.4, latitude=52.5, height=76.25, heading=90)
LIMIT = sys.float_info.max


def holds(bounds: Bounds | None, point: Vector3) -> bool:
    assert bounds is not None
    return all(low <= at <= high for low, at, high in zip(bounds.min, point, bounds.max, strict=True))


def around(anchor: Anchor, corners: list[Vector3], *, with_heights: bool = False) -> str:
    """The box on the Earth that just holds these points of the map, as a request writes it."""
    convert = to_wgs84(anchor)
    lons, lats, heights = zip(*(convert(corner) for corner in corners), strict=True)
    low, high = [min(lons), min(lats)], [max(lons), max(lats)]
    low[0], high[0] = ((lon + 180) % 360 - 180 for lon in (low[0], high[0]))
    if with_heights:
        low, high = [*low, min(heights)], [*high, max(heights)]
    return ",".join(map(repr, [*low, *high]))


def test_without_an_anchor_a_box_is_in_metres_of_the_map() -> None:
    expected = Bounds(min=(0, 1, -LIMIT), max=(2, 3, LIMIT))
    for crs in (None, "map", MAP_FRAME):
        assert bounds_of("0,1,2,3", crs, None) == expected  # type: ignore[arg-type]
    assert bounds_of("0,1,2,3,4,5", None, None) == Bounds(min=(0, 1, 2), max=(3, 4, 5))
    assert bounds_of("0,1,2,3", "map", BERLIN) == expected
    assert bounds_of(None, None, None) is None


def test_with_an_anchor_a_box_without_a_frame_is_on_the_earth() -> None:
    box = around(BERLIN, [(0, 0, 0), (10, 5, 2)])
    for crs in (None, "CRS84", CRS84, "CRS84h", CRS84H):
        found = bounds_of(box, crs, BERLIN)  # type: ignore[arg-type]
        assert found is not None
        assert found.min[:2] == pytest.approx((0, 0), abs=0.05)
        assert found.max[:2] == pytest.approx((10, 5), abs=0.05)
        assert (found.min[2], found.max[2]) == (-LIMIT, LIMIT)


@pytest.mark.parametrize(
    "anchor",
    [
        BERLIN,
        Anchor(longitude=-73.98, latitude=-40.75, height=0, heading=33),
        Anchor(longitude=179.9999, latitude=0, height=10, heading=200),  # on the antimeridian
        Anchor(longitude=-180, latitude=67, height=10, heading=1),
        Anchor(longitude=20, latitude=84.9, height=3000, heading=300),
        Anchor(longitude=20, latitude=89.9999, height=3000, heading=300),  # at the pole
        Anchor(longitude=20, latitude=-90, height=3000, heading=0),
    ],
)
@pytest.mark.parametrize("size", [3.0, 300.0, 10_000.0])
def test_what_lies_in_a_box_on_the_earth_lies_in_its_box_of_the_map(anchor: Anchor, size: float) -> None:
    rng = random.Random(1)
    convert = to_wgs84(anchor)
    for _ in range(50):
        corners = [
            (rng.uniform(-size, size), rng.uniform(-size, size), rng.uniform(-30, 30)) for _ in range(2)
        ]
        box = around(anchor, [*corners], with_heights=True)
        west, south, bottom, east, north, top = map(float, box.split(","))
        found = bounds_of(box, "CRS84h", anchor)
        for corner in corners:
            assert holds(found, corner), (box, found, corner)
        for _ in range(20):  # anything else within it
            inside = rng.uniform(-size, size), rng.uniform(-size, size), rng.uniform(-30, 30)
            lon, lat, height = convert(inside)
            lon = (lon + 180) % 360 - 180
            across = west <= lon <= east if west <= east else lon >= west or lon <= east
            if across and south <= lat <= north and bottom <= height <= top:
                assert holds(found, inside)


def test_heights_on_the_earth_tell_storeys_apart() -> None:
    ground = around(BERLIN, [(0, 0, 0), (60, 40, 2.5)], with_heights=True)
    found = bounds_of(ground, "CRS84h", BERLIN)
    assert found is not None
    assert (found.min[2], found.max[2]) == pytest.approx((0, 2.5), abs=0.02)


def test_a_box_elsewhere_on_the_earth_holds_nothing_of_the_map() -> None:
    # The last goes from 14 degrees eastward around the Earth to 12.
    for box in ("-75,40,-73,41", "13,-53,14,-52", "14,52,15,53", "14,52,12,53"):
        found = bounds_of(box, None, BERLIN)
        assert not holds(found, (0, 0, 0)), box


@pytest.mark.parametrize("box", ["-180,-90,180,90", "13,52,14,53", "100,52,14,53", "13.4,52.5,13.4,52.5"])
def test_a_box_that_holds_the_anchor_holds_the_origin_of_the_map(box: str) -> None:
    assert holds(bounds_of(box, None, BERLIN), (0, 0, 0))


@pytest.mark.parametrize(
    ("box", "crs", "anchor", "name"),
    [
        ("2,0,1,1", None, None, "bbox"),
        ("0,2,1,1", "map", BERLIN, "bbox"),
        ("0,0,200,1", None, BERLIN, "bbox"),
        ("0,50,1,40", None, BERLIN, "bbox"),
        ("0,0,9,1,1,1", "CRS84h", BERLIN, "bbox"),
        ("0,0,1,1", "CRS84", None, "bbox-crs"),
    ],
)
def test_a_box_that_cannot_be_is_refused_by_its_name(
    box: str, crs: str | None, anchor: Anchor | None, name: str
) -> None:
    with pytest.raises(RequestValidationError) as refused:
        bounds_of(box, crs, anchor)  # type: ignore[arg-type]
    assert refused.value.errors()[0]["loc"] == ("query", name)


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,4,5", "a,b,c,d", "0,0,nan,1", "0,0,inf,1"])
def test_a_box_has_four_or_six_numbers(text: str) -> None:
    with pytest.raises(ValueError, match="four or six"):
        numbers_of(text)
