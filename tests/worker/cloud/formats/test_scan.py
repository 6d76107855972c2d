"""Scan: every real file ends in the right points or in an error that names it; so does every broken one."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.support.clouds import write_e57, write_las
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.ply import write_ply
from worker.cloud.formats.scan import Scan, read_scan
from worker.errors import ScanError, ScanFarAway, ScanTooLarge, ScanUnits

WITH_COLORS, PLAIN = True, False
ROOM_808, N_808 = "ipad_rooms/pix4d_database_808_db.ply", 47_043

#: every file of the shared data that is a scan: points kept, points dropped, colours
SOUND = {
    "corridor_pair/cloud_0.ply": (36_674, 0, PLAIN),
    "corridor_pair/cloud_1.ply": (36_670, 0, PLAIN),
    "floor/geb079_occ.ply": (185_673, 0, PLAIN),
    "formats/capture0001_nan_binary.pcd": (249_647, 57_553, PLAIN),
    "formats/pypcd4/ascii.pcd": (213, 0, WITH_COLORS),
    "formats/pypcd4/ascii_multi_count.pcd": (8, 0, PLAIN),
    "formats/pypcd4/ascii_organized.pcd": (8, 0, PLAIN),
    "formats/pypcd4/ascii_with_underscore.pcd": (213, 0, PLAIN),
    "formats/pypcd4/binary.pcd": (213, 0, WITH_COLORS),
    "formats/pypcd4/binary_compressed.pcd": (213, 0, WITH_COLORS),
    "formats/pypcd4/binary_compressed_organized.pcd": (8, 0, PLAIN),
    "formats/room808_ascii.pcd": (N_808, 0, WITH_COLORS),
    "formats/room808_ascii_crlf.ply": (N_808, 0, WITH_COLORS),
    "formats/room808_ascii_rgb.ply": (N_808, 0, WITH_COLORS),
    "formats/room808_be_f32_rgb.ply": (N_808, 0, WITH_COLORS),
    "formats/room808_be_f64_rgb.ply": (N_808, 0, WITH_COLORS),
    "formats/room808_binary.pcd": (N_808, 0, WITH_COLORS),
    "formats/room808_binary_compressed.pcd": (N_808, 0, WITH_COLORS),
    "formats/room808_binary_padding_underscore.pcd": (N_808, 0, PLAIN),
    "formats/room808_binary_ring_f64.pcd": (N_808, 0, PLAIN),
    "formats/room808_le_camera_element_first_plus_faces.ply": (N_808, 0, PLAIN),
    "formats/room808_le_cloudcompare_scalar.ply": (N_808, 0, PLAIN),
    "formats/room808_le_f32_rgb.ply": (N_808, 0, WITH_COLORS),
    "formats/room808_le_nan_inf.ply": (42_290, 4_753, PLAIN),
    "formats/room808_le_oddfields_xyz_not_first.ply": (N_808, 0, PLAIN),
    "ipad_rooms/pix4d_database_560_db.ply": (36_122, 0, WITH_COLORS),
    "ipad_rooms/pix4d_database_808_db.ply": (N_808, 0, WITH_COLORS),
    "ipad_rooms/pix4d_user_560_user.ply": (40_438, 0, WITH_COLORS),
    "ipad_rooms/pix4d_user_808_user.ply": (39_179, 0, WITH_COLORS),
    "kinect_pairwise/capture0001.pcd": (249_647, 57_553, PLAIN),
    "kinect_pairwise/capture0002.pcd": (249_931, 57_269, PLAIN),
    "kinect_pairwise/capture0003.pcd": (248_494, 58_706, PLAIN),
    "kinect_pairwise/capture0004.pcd": (244_573, 62_627, PLAIN),
    "kinect_pairwise/capture0005.pcd": (244_977, 62_223, PLAIN),
    "room_scan/room_scan1.pcd": (112_586, 0, PLAIN),
    "room_scan/room_scan2.pcd": (112_624, 0, PLAIN),
}

#: every other one: what its error says
BROKEN = {
    "formats/pypcd4/ascii_empty.pcd": r"the file is empty \(0 bytes\)",
    "formats/pypcd4/ascii_invalid_header.pcd": "'FIEL' is unknown",
    "formats/pypcd4/ascii_with_empty_points.pcd": "no points are left: 0 declared",
    "formats/room808_binary_compressed_truncated.pcd": "truncated: 739311 bytes .* 47043 points .* holds 369555",
    "formats/room808_binary_truncated.pcd": r"cut off \(truncated\): header declares 47043 points \(752688 bytes\), .* 23515 \(376253",
    "formats/room808_le_truncated.ply": r"cut off \(truncated\): header declares 47043 points \(705645 bytes\), .* 31358 \(470370",
}

VARIANTS_808 = [name for name in SOUND if name.startswith("formats/room808") and "nan_inf" not in name]


def test_the_tables_name_every_scan_of_the_shared_data(shared_data):
    found = {
        p.relative_to(shared_data).as_posix() for p in shared_data.rglob("*") if p.suffix in (".pcd", ".ply")
    }
    assert found <= SOUND.keys() | BROKEN.keys()  # for want of one the test of it is skipped


@pytest.mark.parametrize("file", SOUND)
def test_a_sound_file_gives_its_points(shared_data, file):
    kept, dropped, with_colors = SOUND[file]
    scan = read_scan(shared_data / file)
    assert scan.name == Path(file).name
    assert scan.points.shape == (kept, 3) and scan.points.dtype == np.float32
    assert np.isfinite(scan.points).all()
    assert scan.n_dropped == dropped
    assert (scan.colors is not None) == with_colors
    if scan.colors is not None:
        assert scan.colors.shape == (kept, 3) and scan.colors.dtype == np.uint8
    assert_allclose(scan.sensor_pose[:3, :3] @ scan.sensor_pose[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("file", BROKEN)
def test_a_broken_file_is_refused_by_its_name(shared_data, file):
    with pytest.raises(ScanError, match=BROKEN[file]) as caught:
        read_scan(shared_data / file, name="visit 2.bin")
    assert str(caught.value).startswith("visit 2.bin: ")


@pytest.mark.parametrize("file", VARIANTS_808)
def test_every_way_to_write_room_808_gives_the_same_points(shared_data, file):
    reference, scan = read_scan(shared_data / ROOM_808), read_scan(shared_data / file)
    assert_array_equal(scan.points, reference.points)
    if scan.colors is not None:
        assert_array_equal(scan.colors, reference.colors)


def test_room_808_with_nan_and_inf_keeps_the_others_in_order(shared_data):
    # The file was made from the reference: NaN at every tenth point, inf at 48 others, which start at the fifth.
    reference = read_scan(shared_data / ROOM_808).points
    kept = read_scan(shared_data / "formats/room808_le_nan_inf.ply").points
    where = {point.tobytes(): i for i, point in enumerate(reference)}
    rows = np.array([where[point.tobytes()] for point in kept])
    assert (np.diff(rows) > 0).all()
    assert not np.isin(rows, np.arange(0, N_808, 10)).any() and 5 not in rows


REAL = (ROOM_808, "room_scan/room_scan1.pcd", "corridor_pair/cloud_0.ply", "floor/geb079_occ.ply")


@pytest.mark.parametrize("name", REAL)
def test_a_real_scan_is_the_same_as_e57_and_to_the_millimetre_as_las_and_laz(shared_data, tmp_path, name):
    known = read_scan(shared_data / name)
    colors = None if known.colors is None else [known.colors]
    exact = read_scan(write_e57(tmp_path / "a.e57", [known.points], colors=colors))
    assert_array_equal(exact.points, known.points)
    assert (exact.colors is None) == (known.colors is None)
    for path in (tmp_path / "a.las", tmp_path / "a.laz"):
        read = read_scan(write_las(path, known.points.astype(np.float64)))
        assert_allclose(read.points, known.points, atol=6e-4)


def test_missing_returns_of_a_kinect_are_dropped_and_counted_as_e57(shared_data, tmp_path):
    frame = read_scan(shared_data / "kinect_pairwise/capture0001.pcd")
    points = np.concatenate([np.zeros((frame.n_dropped, 3)), frame.points])
    invalid = 2 * (np.arange(len(points)) < frame.n_dropped)
    scan = read_scan(write_e57(tmp_path / "a.e57", [points], invalid=invalid))
    assert (scan.n_dropped, len(scan.points)) == (57_553, 249_647)
    assert_array_equal(scan.points, frame.points)


def test_a_kinect_frame_is_the_same_packed_and_plain_and_looks_along_a_turned_sensor(shared_data):
    packed = read_scan(shared_data / "kinect_pairwise/capture0001.pcd")
    plain = read_scan(shared_data / "formats/capture0001_nan_binary.pcd")
    assert_array_equal(packed.points, plain.points)
    assert_allclose(packed.sensor_pose, np.diag([1, -1, -1, 1]), atol=1e-12)  # VIEWPOINT 0 0 0 0 1 0 0
    assert_array_equal(plain.sensor_pose, np.eye(4))


def test_the_format_is_told_by_content_not_by_the_ending(tmp_path):
    points = np.array([[0, 0, 0], [4, 3, 2]], np.float32)
    write_ply(tmp_path / "really_ply.pcd", points)
    write_pcd(tmp_path / "really_pcd", points)
    assert_array_equal(read_scan(tmp_path / "really_ply.pcd").points, points)
    assert_array_equal(read_scan(tmp_path / "really_pcd").points, points)


def test_a_file_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "scan.ply"
    path.write_bytes(b"glTF\x02\x00\x00\x00 and more")
    with pytest.raises(ScanError, match=r"^scan.ply: neither PLY, PCD, E57 nor LAS, it starts with b'glTF"):
        read_scan(path)


@pytest.mark.parametrize("name", [ROOM_808, "room_scan/room_scan1.pcd", "corridor_pair/cloud_0.ply"])
def test_a_real_room_in_millimetres_is_refused_with_the_hint(shared_data, tmp_path, name):
    write_pcd(tmp_path / "mm.pcd", read_scan(shared_data / name).points * 1000)
    with pytest.raises(ScanUnits, match=r"^mm.pcd: .*looks like millimetres; multiply by 0.001"):
        read_scan(tmp_path / "mm.pcd")


def hall(length: float) -> np.ndarray:
    """A floor with `length` metres along x, 20 m along y."""
    x, y = np.meshgrid(np.linspace(0, length, 600), np.linspace(0, 20, 40))
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def test_a_hall_of_300_m_is_read_and_one_of_600_m_is_not(tmp_path):
    write_pcd(tmp_path / "hall.pcd", hall(300))
    assert np.ptp(read_scan(tmp_path / "hall.pcd").points[:, 0]) == pytest.approx(300)
    write_pcd(tmp_path / "hall.pcd", hall(600))
    with pytest.raises(ScanUnits, match="over 500 m"):
        read_scan(tmp_path / "hall.pcd")


def test_a_room_of_20_m_in_centimetres_is_refused_with_that_hint(tmp_path):
    write_pcd(tmp_path / "cm.pcd", hall(12) * 100)
    with pytest.raises(ScanUnits, match=r"^cm.pcd: .*looks like centimetres; multiply by 0.01 "):
        read_scan(tmp_path / "cm.pcd")


def test_a_few_points_far_from_all_others_are_left_out_and_counted(tmp_path):
    points = hall(12)
    points[::500] += [2_000, 0, 0]
    colors = np.arange(len(points) * 3).reshape(-1, 3).astype(np.uint8)
    write_ply(tmp_path / "room.ply", points, colors=colors)
    scan = read_scan(tmp_path / "room.ply")
    kept = np.arange(len(points)) % 500 != 0
    assert_array_equal(scan.points, points[kept].astype(np.float32))
    assert_array_equal(scan.colors, colors[kept])
    assert (scan.n_far, scan.n_dropped) == (48, 0)
    assert scan.farthest == pytest.approx(2_006, abs=6)


@pytest.mark.parametrize("away", [300, 5_000, 20_000, 1e30])
def test_one_stray_return_does_not_cost_a_room(tmp_path, away):
    points = hall(12)
    points[7] = [away, 0, 0]
    write_pcd(tmp_path / "room.pcd", points)
    scan = read_scan(tmp_path / "room.pcd")
    assert (len(scan.points), scan.n_far) == (23_999, 1)
    assert scan.farthest == pytest.approx(away, rel=0.03)


def test_a_return_at_the_end_of_a_long_hall_is_kept(tmp_path):
    points = hall(12)
    points[7] = [240, 0, 0]
    write_pcd(tmp_path / "room.pcd", points)
    scan = read_scan(tmp_path / "room.pcd")
    assert (len(scan.points), scan.n_far, scan.farthest) == (24_000, 0, 0.0)


def test_many_points_far_from_the_others_are_refused_for_what_they_are(tmp_path):
    points = hall(12)
    points[::30] += [5_000, 0, 0]
    write_pcd(tmp_path / "room.pcd", points)
    with pytest.raises(
        ScanError, match=r"3.3% of its points lie over 250 m from the others, up to 5.0 km"
    ) as caught:
        read_scan(tmp_path / "room.pcd")
    assert not isinstance(caught.value, ScanUnits)


def test_the_coordinates_of_a_country_s_grid_are_refused_with_an_offset_that_would_do(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 400\n" + "".join(f"property double {a}\n" for a in "xyz")
    rows = "\n".join(f"{450_000 + i % 20:.3f} {5_411_000 + i // 20:.3f} 112.5" for i in range(400))
    (tmp_path / "utm.ply").write_text(f"{head}end_header\n{rows}\n", encoding="ascii")
    with pytest.raises(
        ScanFarAway, match=r"lie 5429.7 km from the origin .* such as \(450000, 5411000, 100\)"
    ):
        read_scan(tmp_path / "utm.ply")


def test_doubles_beyond_float32_and_map_coordinates_are_refused(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property double {a}\n" for a in "xyz")
    path = tmp_path / "far.ply"
    for row, error in (("1e308 -1e308 0", ScanUnits), ("500000.25 4649776.5 12", ScanError)):
        path.write_text(f"{head}end_header\n{row}\n{row.replace('1e308', '2e307')}\n", encoding="ascii")
        with pytest.raises(error, match=r"^far\.ply: "):
            read_scan(path)


def test_a_scan_of_nothing_but_missing_returns_is_refused(tmp_path):
    write_ply(tmp_path / "blind.ply", np.full((3, 3), np.nan, np.float32))
    with pytest.raises(ScanError, match=r"^blind.ply: no points are left: 3 declared, 3 of them NaN or inf"):
        read_scan(tmp_path / "blind.ply")


def small_files() -> dict[str, bytes]:
    """One small valid file of each encoding."""
    rng = np.random.default_rng(5)
    points = rng.uniform(-3, 3, (40, 3)).astype("<f4")
    text = "\n".join(" ".join(f"{v:.4f}" for v in p) for p in points).encode() + b"\n"
    xyz = "property float x\nproperty float y\nproperty float z\n"
    camera = "element camera 2\nproperty list uchar short v\n"
    pcd = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        "WIDTH 40\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA "
    )
    block = np.sort(points.T, axis=1).tobytes()  # sorted, so that LZF finds something to refer back to
    packed = imagecodecs.lzf_encode(block)
    sizes = np.array([len(packed), len(block)], "<u4").tobytes()
    return {
        "ply ascii": f"ply\nformat ascii 1.0\nelement vertex 40\n{xyz}end_header\n".encode() + text,
        "ply big": f"ply\nformat binary_big_endian 1.0\n{camera}element vertex 40\n{xyz}end_header\n".encode()
        + b"\x01\x00\x07\x00" + points.astype(">f4").tobytes(),
        "pcd ascii": f"{pcd}ascii\n".encode() + text,
        "pcd binary": f"{pcd}binary\n".encode() + points.tobytes(),
        "pcd compressed": f"{pcd}binary_compressed\n".encode() + sizes + packed,
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", small_files())
def test_no_damage_ends_in_anything_but_a_scan_or_a_scan_error(tmp_path, kind):
    whole = small_files()[kind]
    path = tmp_path / "scan"
    path.write_bytes(whole)
    assert len(read_scan(path).points) == 40
    rng = np.random.default_rng(11)
    outcomes = {"read": 0, "refused": 0}
    tracemalloc.start()
    for trial in range(400):
        damaged = bytearray(whole)
        if trial % 4 == 0:
            damaged = damaged[: rng.integers(len(whole))]
        else:  # half in the header, half anywhere
            reach = 200 if trial % 2 else len(whole)
            for place in rng.integers(min(reach, len(whole)), size=rng.integers(1, 4)):
                damaged[place] = rng.choice(list(b"0123456789 -\nxF\xff\x00"))
        path.write_bytes(damaged)
        try:
            scan = read_scan(path)
        except ScanError as error:
            assert str(error).startswith("scan: ")
            outcomes["refused"] += 1
        else:
            assert isinstance(scan, Scan) and np.isfinite(scan.points).all()
            outcomes["read"] += 1
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert min(outcomes.values()) > 20, outcomes  # both ways were tried
    assert peak < 8_000_000


def test_memory_that_runs_out_is_a_scan_that_is_too_large(tmp_path, monkeypatch):
    def exhausted(*args, **options):
        raise MemoryError

    write_ply(tmp_path / "big.ply", hall(3))
    monkeypatch.setattr("worker.cloud.formats.scan.read_ply", exhausted)
    with pytest.raises(ScanTooLarge, match=r"^big.ply: its points do not fit in memory"):
        read_scan(tmp_path / "big.ply")


def test_a_scan_is_the_same_whatever_is_gone_through_at_once(tmp_path, monkeypatch):
    rng = np.random.default_rng(3)
    points = rng.uniform(-4, 4, (1000, 3)).astype(np.float32)
    points[rng.random(1000) < 0.3] = np.nan
    colors = rng.integers(0, 256, (1000, 3), np.uint8)
    path = tmp_path / "scan.ply"
    write_ply(path, points, colors=colors)
    whole = read_scan(path)
    monkeypatch.setattr("worker.cloud.formats.scan._AT_ONCE", 7)
    pieces = read_scan(path)
    assert_array_equal(pieces.points, whole.points)
    assert_array_equal(pieces.colors, whole.colors)
    assert pieces.n_dropped == whole.n_dropped == np.isnan(points).any(axis=1).sum()


@pytest.mark.parametrize("at_once", [3, 1000])
def test_far_points_are_counted_wherever_they_lie(tmp_path, monkeypatch, at_once):
    points = np.random.default_rng(3).uniform(-4, 4, (500, 3)).astype(np.float32)
    points[[400, 450], 0] = 20_000, 30_000
    path = tmp_path / "scan.ply"
    write_ply(path, points)
    monkeypatch.setattr("worker.cloud.formats.scan._AT_ONCE", at_once)
    scan = read_scan(path)
    assert_array_equal(scan.points, np.delete(points, [400, 450], axis=0))
    assert (scan.n_far, round(scan.farthest / 1000)) == (2, 30)


def test_lines_are_found_whatever_block_they_lie_in(tmp_path, monkeypatch):
    rows = [f"{i} {i * 0.5} 1" for i in range(200)]
    path = tmp_path / "scan.pcd"
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 200\nHEIGHT 1\nDATA ascii\n"
    path.write_text(head + "\r\n\n".join(rows))
    for limit in (16, 17, 64, 100_000):
        monkeypatch.setattr("worker.cloud.formats.fields.LINE_LIMIT", limit)
        assert_allclose(read_scan(path).points[:, 0], np.arange(200))


def test_long_lines_are_decoded_a_few_at_a_time(tmp_path):
    rows = [" " * 900_000 + f"{i} 0 1" for i in range(60)]
    path = tmp_path / "scan.pcd"
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 60\nHEIGHT 1\nDATA ascii\n"
    path.write_text(head + "\n".join(rows))
    tracemalloc.start()
    try:
        assert len(read_scan(path).points) == 60
        assert tracemalloc.get_traced_memory()[1] < 40e6  # of 54 MB of text
    finally:
        tracemalloc.stop()
