"""A recording of a robot, MCAP or rosbag2: its clouds with their poses, as scans."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import radians
from pathlib import Path
from typing import Any, Literal

from service.robots.bags.clouds import Cloud, CloudError, cloud_of, pcd_of
from service.robots.bags.transforms import NoTransform, Transform, TransformTree, transform

CLOUD = "sensor_msgs/msg/PointCloud2"
TF = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (ODOMETRY, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
FRAMES = ("map", "odom")  #: that poses lead to where none is named: the first that there is (REP 105)
_TF_TOPICS = ("/tf", "/tf_static")
_SECOND = 1_000_000_000


class BagError(Exception):
    """A recording that cannot be used; `str()` says why, with the topics that there are."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BagOptions:
    """What becomes a scan."""

    topic: str | None = None  #: of the clouds; None: the only one that there is
    pose_topic: str | None = None  #: Odometry or PoseStamped; None: /tf and /tf_static
    body_frame: str | None = None  #: whose pose a PoseStamped is; None: the sensor's own. Odometry names it
    frame: str | None = None  #: that the poses lead to
    each: Literal["stop", "time"] = "stop"
    every_s: float = 5.0  #: with `time`: seconds from one scan to the next
    least_stop_s: float = 1.0  #: with `stop`: so long the robot has to stand
    still_m: float = 0.02  #: that it may move meanwhile, metres
    still_deg: float = 1.0  #: and turn, degrees
    most_clouds: int = 20  #: of one stop, which are put together


@dataclass(frozen=True, kw_only=True, slots=True)
class BagScan:
    """One scan of a recording."""

    clouds: tuple[Cloud, ...]
    frame_from_sensor: Transform
    frame: str
    captured_at: datetime

    def pcd(self) -> bytes:
        """Return the points as a PCD, in the sensor's axes."""
        return pcd_of(self.clouds)

    def said(self) -> dict[str, Any]:
        """Return what is said of it, by the names of a sidecar."""
        instant = self.captured_at.isoformat().replace("+00:00", "Z")
        return {"pose": self.frame_from_sensor.matrix(), "frame": self.frame, "captured_at": instant}


@dataclass(slots=True)
class _Still:
    """Clouds that were taken while the robot stood."""

    begun: int
    pose: Transform
    frame: str
    ended: int = 0
    clouds: list[Cloud] = field(default_factory=list)


class Recording:
    """A recording that is open; a context manager. Raises BagError wherever it is read."""

    def __init__(self, path: Path) -> None:
        """Take a folder of rosbag2, or a single .mcap or .db3 file."""
        self.skipped: dict[str, int] = {}  #: why clouds became no scan, and how many
        self._path = path
        self._reader = _open(path)
        self._topics: dict[str, str] = {
            connection.topic: connection.msgtype for connection in self._reader.connections
        }

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def scans(self, options: BagOptions) -> Iterator[BagScan]:
        """Yield the scans in the order of the recording, each as soon as it is known to be one."""
        topic: str = self._cloud_topic(options.topic)
        tree = self._transforms(topic, options)
        posed = self._posed(topic, tree, options)
        yield from (_each_stop if options.each == "stop" else _each_so_often)(posed, options)

    def topics(self) -> str:
        """Return the topics as a sentence has them."""
        return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self._topics.items())) or "none"

    def _cloud_topic(self, wanted: str | None) -> str:
        if wanted is None:
            clouds = [topic for topic, kind in self._topics.items() if kind == CLOUD]
            if len(clouds) == 1:
                return clouds[0]
            how_many = f"{len(clouds)} topics with" if clouds else "no topic with"
            raise BagError(f"{how_many} {CLOUD}; name one with --topic. The topics are: {self.topics()}")
        if self._topics.get(wanted) != CLOUD:
            raise BagError(f"no topic {wanted!r} with {CLOUD}. The topics are: {self.topics()}")
        return wanted

    def _transforms(self, cloud_topic: str, options: BagOptions) -> TransformTree:
        tree = TransformTree()
        if options.pose_topic is not None and self._topics.get(options.pose_topic) not in POSES:
            raise BagError(
                f"no topic {options.pose_topic!r} with a pose ({', '.join(POSES)}). The topics are: {self.topics()}"
            )
        if options.pose_topic is None and not any(self._topics.get(name) == TF for name in _TF_TOPICS):
            raise BagError(
                f"no /tf, so that no cloud has a pose; name a topic of poses with --pose-topic. The topics are: "
                f"{self.topics()}"
            )
        for topic, _, message in self._messages(*_TF_TOPICS):
            for one in message.transforms:
                with contextlib.suppress(NoTransform):
                    parent_from_child = _transform(one.transform.translation, one.transform.rotation)
                    tree.add(
                        one.header.frame_id,
                        one.child_frame_id,
                        _stamp(one.header),
                        parent_from_child,
                        is_static=topic == "/tf_static",
                    )
        if options.pose_topic is not None:
            self._add_poses(tree, cloud_topic, options)
        return tree

    def _add_poses(self, tree: TransformTree, cloud_topic: str, options: BagOptions) -> None:
        """Hang the body that the poses are of on the frame that they lead to."""
        is_odometry = self._topics[options.pose_topic or ""] == ODOMETRY
        body = options.body_frame
        if body is None and not is_odometry:
            first = next(iter(self._messages(cloud_topic)), None)
            body = str(first[2].header.frame_id) if first else "sensor"
        dropped: set[str] = set()
        for _, _, message in self._messages(options.pose_topic or ""):
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            child = body or message.child_frame_id
            if child not in dropped:  # the topic was asked for, and /tf may say something else
                tree.drop(child)
                dropped.add(child)
            with contextlib.suppress(NoTransform):
                frame_from_body = _transform(pose.position, pose.orientation)
                tree.add(message.header.frame_id, child, _stamp(message.header), frame_from_body)

    def _posed(
        self, topic: str, tree: TransformTree, options: BagOptions
    ) -> Iterator[tuple[int, Transform, str, Any]]:
        """Yield each cloud with its time, its pose and the frame of that; one without a pose is counted."""
        frame = options.frame or next((name for name in FRAMES if name in tree.frames()), None)
        if frame is None or frame not in tree.frames():
            there = ", ".join(tree.frames()) or "none"
            raise BagError(
                f"no frame {frame or ' or '.join(FRAMES)}; name one with --frame. The frames are: {there}"
            )
        found = False
        for _, recorded, message in self._messages(topic):
            stamp = _stamp(message.header) or recorded
            try:
                pose = tree.lookup(frame, message.header.frame_id.lstrip("/"), stamp)
            except NoTransform as error:
                self.skipped[str(error)] = self.skipped.get(str(error), 0) + 1
                continue
            found = True
            yield stamp, pose, frame, message
        if not found:
            why = "; ".join(self.skipped) or f"{topic} has no messages"
            raise BagError(f"no cloud has a pose in {frame!r}: {why}")

    def _messages(self, *topics: str) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording and message."""
        wanted = [connection for connection in self._reader.connections if connection.topic in topics]
        if not wanted:
            return
        try:
            for connection, recorded, raw in self._reader.messages(connections=wanted):
                yield connection.topic, recorded, self._reader.deserialize(raw, connection.msgtype)
        except (BagError, CloudError, NoTransform, GeneratorExit):
            raise
        except Exception as error:  # the library raises what its parts do
            raise BagError(f"{self._path.name} cannot be read: {type(error).__name__}: {error}") from error


def write(scan: BagScan, folder: Path, name: str, **said: Any) -> Path:
    """Write a scan and its sidecar into a folder, where a watcher may stand by; returns the scan's path."""
    path = folder / f"{name}.pcd"
    about = {**scan.said(), **{key: value for key, value in said.items() if value is not None}}
    aside = folder / f".{name}.part"
    aside.write_text(json.dumps(about))
    aside.replace(folder / f"{name}.pose.json")
    aside.write_bytes(scan.pcd())
    return aside.replace(path)


def _each_stop(posed: Iterator[tuple[int, Transform, str, Any]], options: BagOptions) -> Iterator[BagScan]:
    """Yield what was seen each time that the robot stood."""
    still: _Still | None = None
    for stamp, pose, frame, message in posed:
        if still is None or _moved(still.pose, pose, options):
            yield from _scan_of(still, options)
            still = _Still(stamp, pose, frame)
        still.ended = stamp
        if len(still.clouds) < options.most_clouds:
            still.clouds.append(_cloud(message))
    yield from _scan_of(still, options)


def _each_so_often(
    posed: Iterator[tuple[int, Transform, str, Any]], options: BagOptions
) -> Iterator[BagScan]:
    """Yield a cloud every so many seconds, wherever the robot is."""
    due: int | None = None
    for stamp, pose, frame, message in posed:
        if due is None or stamp >= due:
            due = stamp + round(options.every_s * _SECOND)
            yield BagScan(
                clouds=(_cloud(message),), frame_from_sensor=pose, frame=frame, captured_at=_instant(stamp)
            )


def _scan_of(still: _Still | None, options: BagOptions) -> Iterator[BagScan]:
    if still is not None and still.ended - still.begun >= options.least_stop_s * _SECOND:
        yield BagScan(
            clouds=tuple(still.clouds),
            frame_from_sensor=still.pose,
            frame=still.frame,
            captured_at=_instant(still.begun),
        )


def _moved(a: Transform, b: Transform, options: BagOptions) -> bool:
    return a.distance(b) > options.still_m or a.angle(b) > radians(options.still_deg)


def _cloud(message: Any) -> Cloud:
    try:
        return cloud_of(message)
    except CloudError as error:
        raise BagError(str(error)) from error


def _transform(position: Any, rotation: Any) -> Transform:
    return transform((position.x, position.y, position.z), (rotation.x, rotation.y, rotation.z, rotation.w))


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * _SECOND + int(header.stamp.nanosec)


def _instant(stamp: int) -> datetime:
    return datetime.fromtimestamp(stamp / _SECOND, UTC)


def _reason(error: Exception) -> str:
    """Return what a library says, without the address of its line."""
    return str(error).strip().rstrip(".") or type(error).__name__


def _open(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415  # an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise BagError(
            "reading recordings of ROS needs the package rosbags: pip install 'spicd[ros]'"
        ) from error
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BagError(
            f"no metadata.yaml in {path}; name the folder that `ros2 bag record` made, or an .mcap or .db3"
        )
    if path.is_file() and path.stat().st_size == 0:
        raise BagError(f"{path} is empty (0 bytes); copy or record it again")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # the library raises what its parts do
        raise BagError(
            f"{path} is no recording that can be read (a folder of rosbag2, .mcap, .db3): {_reason(error)}"
        ) from error
    return reader
