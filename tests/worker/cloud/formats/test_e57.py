"""E57: sound files with known points, and files that were damaged or made to do harm."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pye57 import libe57
from scipy.spatial.transform import Rotation

from tests.support.clouds import damage_station, split_xml, with_xml, write_e57, write_e57_nodes
from worker.cloud.formats.apart import stations_of
from worker.cloud.formats.scan import Scan, read_scan
from worker.cloud.poses import translation
from worker.errors import ScanError, ScanTooLarge
from worker.pipeline.registration.results import ScanFile, files_of

N = 1500
XYZ = ("cartesianX", "cartesianY", "cartesianZ")
RGB = ("colorRed", "colorGreen", "colorBlue")


def room(seed: int = 0) -> np.ndarray:
    """Points (N, 3) in a room of 6 x 4 x 3 m, as a float32 has them."""
    return np.random.default_rng(seed).uniform((-3, -2, 0), (3, 2, 3), (N, 3)).astype("f").astype("d")


def pose_of(x: float, degrees: float) -> np.ndarray:
    pose = translation(np.array([x, 1.0, 0.5]))
    pose[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return pose


def read(path: Path, **known: Any) -> Scan:
    """Read a file in this process."""
    return read_scan(path, apart=False, **known)


def with_words(path: Path, old: bytes, new: bytes) -> Path:
    """The file with other words in its XML; every checksum holds."""
    before, xml = split_xml(path.read_bytes())
    assert old in xml
    path.write_bytes(with_xml(before, xml.replace(old, new)))
    return path


def test_points_colours_and_the_pose_of_one_station_are_read(tmp_path):
    colors = np.stack([np.arange(N) % 256, np.full(N, 255), np.zeros(N)], axis=1)
    path = write_e57(tmp_path / "hall.e57", [room()], poses=[pose_of(4, 30)], colors=[colors])
    scan = read(path)
    assert_array_equal(scan.points, room().astype("f"))
    assert_array_equal(scan.colors, colors)
    assert scan.prior is not None
    assert_allclose(scan.prior, pose_of(4, 30), atol=1e-12)
    assert_array_equal(scan.sensor_pose, np.eye(4))  # points are in the station's own frame
    assert scan.tells_sensor


def test_a_station_at_a_time_is_read_of_several_and_none_without_a_number(tmp_path):
    path = write_e57(tmp_path / "hall.e57", [room(0), room(1)], poses=[pose_of(0, 0), pose_of(4, 30)])
    assert [(one.name, one.n) for one in stations_of(path)] == [("station 1", N), ("station 2", N)]
    for station in (0, 1):
        assert_array_equal(read(path, station=station).points, room(station).astype("f"))
    with pytest.raises(ScanError, match="holds 2 scans, each from its own place"):
        read(path)
    with pytest.raises(ScanTooLarge, match="2 scans declare 3000 points together, the limit is 2000"):
        read(path, max_points=2000)
    assert [file.station for file in files_of(path)] == [0, 1]


def test_a_station_that_cannot_be_read_leaves_the_others(tmp_path):
    path = write_e57(tmp_path / "hall.e57", [room(0), room(1)], poses=[pose_of(0, 0), pose_of(4, 30)])
    damage_station(path, 0)
    assert_array_equal(read(path, station=1).points, room(1).astype("f"))
    with pytest.raises(ScanError, match="its points are damaged"):
        read(path, station=0)


def test_a_station_that_declares_what_cannot_be_leaves_the_others(tmp_path):
    sound = [room(0)[:1400], room(1)]
    path = write_e57(tmp_path / "hall.e57", sound, poses=[pose_of(0, 0), pose_of(4, 30)])
    with_words(path, b'recordCount="1400"', b'recordCount="9999"')
    assert [(one.name, one.n) for one in stations_of(path)] == [("station 1", 0), ("station 2", N)]
    assert_array_equal(read(path, station=1).points, room(1).astype("f"))
    with pytest.raises(ScanError, match="scan 1 declares 9999 points"):
        read(path, station=0)


def test_a_real_room_is_the_same_as_e57(shared_data, tmp_path):
    known = read_scan(shared_data / "formats/room808_le_f32_rgb.ply")
    assert known.colors is not None
    path = write_e57(tmp_path / "room.e57", [known.points], colors=[known.colors])
    scan = read_scan(path)  # in a process of its own, as a worker does
    assert_array_equal(scan.points, known.points)
    assert_array_equal(scan.colors, known.colors)


def test_invalid_points_are_dropped_and_counted(tmp_path):
    invalid = np.zeros(N)
    invalid[:5], invalid[5:9] = 1, 2  # a direction alone; nothing
    scan = read(write_e57(tmp_path / "hall.e57", [room()], invalid=invalid))
    assert scan.n_dropped == 9
    assert_array_equal(scan.points, room()[9:].astype("f"))


def doubles(low: float = -10, high: float = 10):
    return lambda image: libe57.FloatNode(image, 0, libe57.E57_DOUBLE, low, high)


def integers(low: int, high: int):
    return lambda image: libe57.IntegerNode(image, low, low, high)


def test_spherical_coordinates_are_turned_into_metres(tmp_path):
    points = room()
    distance = np.linalg.norm(points, axis=1)
    angles = np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / distance)
    fields = {
        "sphericalRange": (doubles(), distance),
        "sphericalAzimuth": (doubles(), angles[0]),
        "sphericalElevation": (doubles(), angles[1]),
        "sphericalInvalidState": (integers(0, 2), (np.arange(N) < 3).astype("b")),
    }
    scan = read(write_e57_nodes(tmp_path / "turning.e57", fields))
    assert scan.n_dropped == 3
    assert_allclose(scan.points, points[3:], atol=1e-6)


def test_scaled_integers_in_a_grid_lose_a_round_offset_and_no_millimetre(tmp_path):
    points = np.round(room(), 3) + np.array([412_345, 5_654_321, 118])
    fields = {}
    for name, values, at in zip(XYZ, points.T, (412_000, 5_654_000, 0), strict=True):
        scaled = lambda image, at=at: libe57.ScaledIntegerNode(image, 0, -(10**6), 10**6, 0.001, at)  # noqa: E731
        fields[name] = (scaled, values)
    scan = read(write_e57_nodes(tmp_path / "grid.e57", fields))
    assert_array_equal(scan.offset, [412_300, 5_654_300, 100])
    assert_allclose(scan.points + scan.offset, points, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "values", "limits"),
    [
        (integers(0, 65_535), np.array([0, 32_896, 65_535]), None),
        (integers(0, 255), np.array([0, 128, 255]), None),
        (integers(0, 1023), np.array([0, 128, 255]), (0, 255)),
        (
            lambda image: libe57.FloatNode(image, 0, libe57.E57_SINGLE, 0, 1),
            np.array([0, 128 / 255, 1]),
            None,
        ),
    ],
)
def test_colours_of_any_range_are_scaled_to_eight_bits(tmp_path, make, values, limits):
    def declare(image, scan):
        if limits is not None:
            node = libe57.StructureNode(image)
            for name in RGB:
                node.set(f"{name}Minimum", libe57.IntegerNode(image, limits[0]))
                node.set(f"{name}Maximum", libe57.IntegerNode(image, limits[1]))
            scan.set("colorLimits", node)

    fields = {name: (doubles(), room()[:3, axis]) for axis, name in enumerate(XYZ)}
    fields |= {name: (make, values.astype("d")) for name in RGB}
    scan = read(write_e57_nodes(tmp_path / "coloured.e57", fields, declare))
    assert_array_equal(scan.colors, np.array([[0] * 3, [128] * 3, [255] * 3]))


def test_the_pose_of_the_file_is_the_prior_unless_the_client_gives_one_or_nobody_registered_it():
    file = ScanFile(name="hall.e57", path=Path("hall.e57"))
    own = pose_of(4, 30)
    assert_array_equal(file.prior(np.eye(4), own=own), own)
    assert file.prior(np.eye(4), own=np.eye(4)) is None
    assert file.prior(np.eye(4), own=pose_of(412_345, 0)) is None  # in a country's grid
    told = ScanFile(name="hall.e57", path=Path("hall.e57"), pose=np.eye(4))
    assert_array_equal(told.prior(np.eye(4), own=own), np.eye(4))
    offset = np.array([100.0, 0, 0])
    assert_array_equal(told.prior(np.eye(4), offset=offset), translation(offset))


@pytest.mark.parametrize("share", [0.001, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path, share):
    path = write_e57(tmp_path / "hall.e57", [room()])
    content = path.read_bytes()
    path.write_bytes(content[: max(9, int(share * len(content)))])
    with pytest.raises(ScanError, match="truncated"):
        read(path)


def test_a_flipped_bit_of_points_or_xml_is_found_by_the_checksum_of_its_page(tmp_path):
    path = write_e57(tmp_path / "hall.e57", [room()])
    content = path.read_bytes()
    for at in (1500, 9000, struct.unpack_from("<Q", content, 24)[0] + 40):
        path.write_bytes(content[:at] + bytes([content[at] ^ 0x10]) + content[at + 1 :])
        with pytest.raises(ScanError, match=r"CHECKSUM|damaged|XML"):
            read_scan(path)


BILLION = b'<!DOCTYPE lol [<!ENTITY a "aaaaaaaaaa">' + b"".join(
    b'<!ENTITY %c "%s">' % (letter + 1, b"&%c;" % letter * 10) for letter in range(97, 110)
)

#: words of the XML, what stands in their place, and what is said of it
XML = [
    (b"<e57Root", BILLION + b"]><e57Root", "document type or entities"),
    (b"<e57Root", b'<!DOCTYPE x SYSTEM "file:///etc/passwd"><e57Root', "document type or entities"),
    (b"<e57Root", b'<!DOCTYPE x [<!ENTITY % y SYSTEM "http://127.0.0.1/"> %y;]><e57Root', "document type"),
    (b'encoding="UTF-8"', b'encoding="UTF-16"', "XML"),
    (b'encoding="UTF-8"', b'encoding="no-such"', "XML is damaged"),
    (
        b'recordCount="1500"',
        b'recordCount="150000000"',
        "header declares 150000000 points, the limit|truncated",
    ),
    (b'recordCount="1500"', b'recordCount="40000"', "declares 40000 points of 96 bits"),
    (b'recordCount="1500"', b'recordCount="1501"', r"truncated|damaged"),
    (b'recordCount="1500"', b'recordCount="-1"', "'-1' is not a whole number"),
    (b'recordCount="1500"', b'recordCount="99999999999999999999"', "is not a whole number"),
    (b'recordCount="1500"', b'recordCount="0"', "no points are in it"),
    (b'fileOffset="48"', b'fileOffset="99999999999"', "points at byte 99999999999"),
    (b'fileOffset="48"', b'fileOffset="47"', "where nothing can begin"),
    (b'fileOffset="48"', b'fileOffset="1500"', "truncated|damaged"),
    (b"<cartesianX ", b"<nordX ", "XML is damaged|has no cartesianX|no sphericalRange"),
    (b'type="CompressedVector"', b'type="Structure"', "points of 'Structure'"),
    (b'<data3D type="Vector"', b'<data3D type="Structure"', "no points are in it"),
    (b'<cartesianX type="Float"', b'<cartesianX type="String"', "has no cartesianX|no sphericalRange"),
    (b"</pose>", b"<translation/></pose>", None),
    (b">4<", b">nan<", "'nan' is not a number"),
    (b"<e57Root", b"<e57Root " + b" ".join(b'a%d="1"' % n for n in range(9)), None),
]


@pytest.mark.parametrize(("old", "new", "said"), XML)
def test_an_xml_that_is_not_of_these_points_is_an_error(tmp_path, old, new, said):
    pose = pose_of(4, 30)
    path = with_words(
        write_e57(tmp_path / "hall.e57", [room()], poses=[pose]), b"<formatName", b"<formatName"
    )
    assert len(read(path).points) == N  # written anew it is as sound as before
    try:
        scan = read_scan(with_words(path, old, new))
    except ScanError as error:
        assert said is None or re.search(said, str(error)), str(error)
    else:
        assert said is None
        assert len(scan.points) == N


def test_an_xml_that_is_nested_or_long_beyond_reason_is_refused(tmp_path):
    for words in (b"<a>" * 60 + b"</a>" * 60, b"<a/>" * 500_001):
        path = write_e57(tmp_path / "hall.e57", [room()])
        with pytest.raises(ScanError, match="elements, or is nested deeper"):
            read(with_words(path, b"</e57Root>", words + b"</e57Root>"))
    path = write_e57(tmp_path / "hall.e57", [room()])
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, 32, 1 << 40)
    path.write_bytes(content)
    with pytest.raises(ScanTooLarge, match="its XML has 1099511627776 bytes"):
        read(path)


def test_points_that_are_said_to_lie_at_one_place_are_refused(tmp_path):
    fields = {name: (integers(1, 1), np.ones(9)) for name in XYZ}
    with pytest.raises(ScanError, match="declared to lie at one place"):
        read(write_e57_nodes(tmp_path / "one.e57", fields))
