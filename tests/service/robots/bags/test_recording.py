"""Recordings of ROS as scans: clouds as they were, poses as the robot stood, and errors that name what there is."""

from __future__ import annotations

import json
import math
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.cli import main
from service.robots.bags.recording import BagError, BagOptions, BagScan, Recording, write
from service.robots.bags.transforms import IDENTITY, NoTransform, Transform, TransformTree, between, transform
from worker.cloud.formats.scan import read_scan

rosbags = pytest.importorskip("rosbags.rosbag2")
from rosbags.typesys import Stores, get_typestore  # noqa: E402

SECOND = 1_000_000_000
BEGIN = 1_772_366_400 * SECOND  #: 2026-03-01T12:00:00Z
TYPES = get_typestore(Stores.ROS2_HUMBLE)
MOUNT = Transform((0.1, 0.0, 0.5), (0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8)))  #: 45 degrees
ROOM = np.random.default_rng(5).uniform(-4, 4, (500, 3)).astype(np.float32)  #: points on the map, metres


def made(kind: str, **values: Any) -> Any:
    return TYPES.types[kind](**values)


def header(stamp: int, frame: str) -> Any:
    time = made("builtin_interfaces/msg/Time", sec=stamp // SECOND, nanosec=stamp % SECOND)
    return made("std_msgs/msg/Header", stamp=time, frame_id=frame)


def numbers(kind: str, values: Any) -> Any:
    return made(kind, **dict(zip("xyzw", values, strict=False)))


def tf(stamp: int, parent: str, child: str, pose: Transform) -> Any:
    both = made(
        "geometry_msgs/msg/Transform",
        translation=numbers("geometry_msgs/msg/Vector3", pose.position),
        rotation=numbers("geometry_msgs/msg/Quaternion", pose.rotation),
    )
    one = made(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp, parent),
        child_frame_id=child,
        transform=both,
    )
    return made("tf2_msgs/msg/TFMessage", transforms=[one])


def pose_of(pose: Transform) -> Any:
    return made(
        "geometry_msgs/msg/Pose",
        position=numbers("geometry_msgs/msg/Point", pose.position),
        orientation=numbers("geometry_msgs/msg/Quaternion", pose.rotation),
    )


def odometry(stamp: int, pose: Transform) -> Any:
    nothing = made(
        "geometry_msgs/msg/Twist",
        linear=numbers("geometry_msgs/msg/Vector3", (0.0, 0.0, 0.0)),
        angular=numbers("geometry_msgs/msg/Vector3", (0.0, 0.0, 0.0)),
    )
    return made(
        "nav_msgs/msg/Odometry",
        header=header(stamp, "odom"),
        child_frame_id="base_link",
        pose=made("geometry_msgs/msg/PoseWithCovariance", pose=pose_of(pose), covariance=np.zeros(36)),
        twist=made("geometry_msgs/msg/TwistWithCovariance", twist=nothing, covariance=np.zeros(36)),
    )


def cloud(
    stamp: int, points: np.ndarray, *, frame: str = "lidar", padding: int = 4, row_padding: int = 6
) -> Any:
    """As drivers send it: intensity behind a gap, and rows that are longer than their points; little-endian."""
    step = 16 + padding
    fields = [
        made("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=7, count=1)
        for name, offset in (("x", 0), ("y", 4), ("z", 8), ("intensity", 12 + padding))
    ]
    half = len(points) // 2
    data = b""
    for row in (points[:half], points[half:]):
        raw = np.zeros((half, step), np.uint8)
        raw[:, :12] = np.ascontiguousarray(row, "<f4").view(np.uint8).reshape(half, 12)
        raw[:, 12 + padding :] = np.full((half, 1), 7.5, "<f4").view(np.uint8)
        data += raw.tobytes() + bytes(row_padding)
    return made(
        "sensor_msgs/msg/PointCloud2",
        header=header(stamp, frame),
        height=2,
        width=half,
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=half * step + row_padding,
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )


def moved(points: np.ndarray, pose: Transform) -> np.ndarray:
    """Points of the map in the axes of a sensor at `pose`."""
    matrix = np.array(pose.inverse().matrix())
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def where(seconds: float) -> Transform:
    """Where the robot is: it stands until 3 s, drives 2 m and turns by 90 degrees until 5 s, and stands until 8 s."""
    share = min(1.0, max(0.0, (seconds - 3) / 2))
    yaw = share * math.pi / 2
    return Transform((2 * share, 0.0, 0.0), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))


@pytest.fixture(params=["MCAP", "SQLITE3"])
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Eight seconds: clouds ten times a second, transforms five times a second between them, and odometry."""
    path = tmp_path / "patrol"
    plugin = getattr(rosbags.StoragePlugin, request.param)
    with rosbags.Writer(path, version=9, storage_plugin=plugin) as writer:

        def send(topic: str, kind: str, stamp: int, message: Any) -> None:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(topics[topic], stamp, TYPES.serialize_cdr(message, kind))

        topics: dict[str, Any] = {}
        send("/tf_static", "tf2_msgs/msg/TFMessage", BEGIN, tf(BEGIN, "base_link", "lidar", MOUNT))
        for tenth in range(81):
            stamp, pose = BEGIN + tenth * SECOND // 10, where(tenth / 10)
            if tenth % 2 == 0:
                send("/tf", "tf2_msgs/msg/TFMessage", stamp, tf(stamp, "odom", "base_link", pose))
                send("/odom", "nav_msgs/msg/Odometry", stamp, odometry(stamp, pose))
            points = moved(ROOM, pose @ MOUNT)
            send("/points", "sensor_msgs/msg/PointCloud2", stamp, cloud(stamp, points))
    return path


def scans_of(bag: Path, **options: Any) -> list[BagScan]:
    with Recording(bag) as recording:
        return list(recording.scans(BagOptions(**options)))


def on_the_map(scan: BagScan, tmp_path: Path) -> np.ndarray:
    """The points of a scan as our own reader reads them, by its pose."""
    path = write(scan, tmp_path, "scan")
    points = read_scan(path).points
    matrix = np.array(json.loads((tmp_path / "scan.pose.json").read_text())["pose"])
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def test_each_stop_is_a_scan_within_a_millimetre(bag: Path, tmp_path: Path) -> None:
    first, second = scans_of(bag)
    assert first.captured_at == datetime(2026, 3, 1, 12, tzinfo=UTC)
    assert (
        second.frame_from_sensor.distance(where(6) @ MOUNT) < 2e-2
    )  # a stop begins while the robot still rolls out
    assert (first.frame, len(first.clouds)) == ("odom", 20)
    for scan in (first, second):
        points = on_the_map(scan, tmp_path)
        assert len(points) == 20 * len(ROOM)
        assert np.abs(points.reshape(20, -1, 3)[0] - ROOM).max() < 1e-3


@pytest.mark.parametrize("pose_topic", [None, "/odom"])
def test_clouds_between_two_poses_are_interpolated(bag: Path, tmp_path: Path, pose_topic: str | None) -> None:
    """Every other cloud was taken halfway between two transforms, while the robot turned and drove."""
    scans = scans_of(bag, each="time", every_s=0.1, pose_topic=pose_topic)
    assert len(scans) == 81
    for tenth, scan in enumerate(scans):
        true = where(tenth / 10) @ MOUNT
        assert scan.frame_from_sensor.distance(true) < 1e-6
        assert scan.frame_from_sensor.angle(true) < 1e-6
    assert np.abs(on_the_map(scans[41], tmp_path) - ROOM).max() < 1e-3


def test_intensity_comes_along(bag: Path, tmp_path: Path) -> None:
    scan = scans_of(bag)[0]
    header, _, data = scan.pcd().partition(b"DATA binary\n")
    assert b"FIELDS x y z intensity\n" in header
    assert np.frombuffer(data, "<f4").reshape(-1, 4)[:, 3] == pytest.approx(7.5)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"topic": "/lidar"}, r"no topic '/lidar' with sensor_msgs/msg/PointCloud2.*/points \(sensor_msgs"),
        ({"topic": "/odom"}, r"no topic '/odom' with sensor_msgs/msg/PointCloud2.*/odom \(nav_msgs"),
        ({"pose_topic": "/pose"}, r"no topic '/pose' with a pose.*/odom \(nav_msgs/msg/Odometry\)"),
        ({"frame": "map"}, "no frame map.*base_link, lidar, odom"),
    ],
)
def test_a_wrong_name_is_told_with_those_there_are(bag: Path, options: dict[str, str], told: str) -> None:
    with pytest.raises(BagError, match=told):
        scans_of(bag, **options)


def test_what_is_no_recording_is_told(tmp_path: Path) -> None:
    (tmp_path / "patrol.mcap").write_bytes(b"not that")
    with pytest.raises(BagError, match=r"patrol\.mcap is no recording"):
        Recording(tmp_path / "patrol.mcap")


def test_an_empty_folder_or_file_is_told_in_plain_words(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=f"^no metadata.yaml in {tmp_path}"):
        Recording(tmp_path)
    (tmp_path / "x.mcap").touch()
    with pytest.raises(BagError, match=r"x\.mcap is empty \(0 bytes\)"):
        Recording(tmp_path / "x.mcap")
    (tmp_path / "y.mcap").write_bytes(b"no recording at all")
    with pytest.raises(BagError, match=r"y\.mcap is no recording") as error:
        Recording(tmp_path / "y.mcap")
    assert "Error:" not in str(error.value)


def test_without_the_library_the_extra_is_named(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(BagError, match=r"pip install 'spicd\[ros\]'"):
        Recording(bag)


def test_the_command_writes_scans_with_their_sidecars(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "--json",
                "scans",
                "from-bag",
                str(bag),
                "--to",
                str(tmp_path / "scans"),
                "--device-id",
                "robot-7",
            ]
        )
    assert ended.value.code in (0, None)
    told = json.loads(capsys.readouterr().out)
    assert [Path(one["file"]).name for one in told] == ["patrol-0001.pcd", "patrol-0002.pcd"]
    assert sorted(path.name for path in (tmp_path / "scans").iterdir()) == [
        "patrol-0001.pcd", "patrol-0001.pose.json", "patrol-0002.pcd", "patrol-0002.pose.json",
    ]  # fmt: skip
    said = json.loads((tmp_path / "scans/patrol-0001.pose.json").read_text())
    assert (said["frame"], said["captured_at"], said["device_id"]) == (
        "odom",
        "2026-03-01T12:00:00Z",
        "robot-7",
    )


def test_a_transform_and_back_is_none() -> None:
    pose = transform((1, 2, 3), (0.5, -0.5, 0.5, 0.5)) @ MOUNT
    assert (pose @ pose.inverse()).distance(IDENTITY) < 1e-12
    assert (pose @ pose.inverse()).angle(IDENTITY) < 1e-6


def test_turning_is_even_and_takes_the_shorter_way() -> None:
    turned = transform(
        (0, 0, 0), (0, 0, -math.sin(0.5), -math.cos(0.5))
    )  # 1 rad, written the other way round
    third = between(IDENTITY, turned, 1 / 3)
    assert third.angle(IDENTITY) == pytest.approx(1 / 3)


def test_frames_that_share_no_root_and_gaps_are_told() -> None:
    tree = TransformTree()
    tree.add("map", "base", 0, IDENTITY)
    tree.add("map", "base", 5 * SECOND, IDENTITY)
    tree.add("other", "lidar", 0, IDENTITY, is_static=True)
    with pytest.raises(NoTransform, match="no frame joins 'lidar' and 'map'"):
        tree.lookup("map", "lidar", 0)
    with pytest.raises(NoTransform, match=r"in a gap of 5\.0 s"):
        tree.lookup("map", "base", SECOND)
    with pytest.raises(NoTransform, match=r"1\.00 s outside"):
        tree.lookup("map", "base", 6 * SECOND)
