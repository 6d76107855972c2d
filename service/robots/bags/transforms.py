"""Transforms between frames over time, as tf2 keeps them: a tree of frames, interpolated between two messages.

`parent_from_child` takes points of the child's axes to the parent's: what geometry_msgs/TransformStamped holds, and
nav_msgs/Odometry of its `child_frame_id`. Plain numbers: a recording has some thousands of them.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

from service.poses import from_position_and_quaternion

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  #: x y z w

REACH_NS = 100_000_000  #: that a pose may lie before the first or behind the last message, which it is then
GAP_NS = 2_000_000_000  #: between two messages, over which nothing is interpolated
_NEARLY_EQUAL = 0.9995  #: of two quaternions' dot product; slerp divides by next to nothing there


class NoTransform(Exception):
    """There is no way from one frame to the other at that time; `str()` says why."""


@dataclass(frozen=True, slots=True)
class Transform:
    """A rotation and then a shift."""

    position: Vector  #: metres
    rotation: Quaternion  #: unit

    def __matmul__(self, other: Transform) -> Transform:
        """Return a_from_c of a_from_b and b_from_c."""
        x, y, z = _rotated(self.rotation, other.position)
        a, b, c = self.position
        return Transform((a + x, b + y, c + z), _product(self.rotation, other.rotation))

    def inverse(self) -> Transform:
        """Return b_from_a of a_from_b."""
        x, y, z, w = self.rotation
        back = (-x, -y, -z, w)
        a, b, c = _rotated(back, self.position)
        return Transform((-a, -b, -c), back)

    def matrix(self) -> list[list[float]]:
        """Return the same as 4x4 rows."""
        return from_position_and_quaternion(*self.position, *self.rotation)

    def distance(self, other: Transform) -> float:
        """Return how far the two origins are apart, metres."""
        return math.dist(self.position, other.position)

    def angle(self, other: Transform) -> float:
        """Return the angle between the two rotations, radians."""
        dot = abs(sum(a * b for a, b in zip(self.rotation, other.rotation, strict=True)))
        return 2 * math.acos(min(1.0, dot))


IDENTITY = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def transform(position: Sequence[float], rotation: Sequence[float]) -> Transform:
    """Return a transform, its quaternion `x y z w` made a unit one. Raises NoTransform for one that is none."""
    norm = math.hypot(*rotation)
    if not 0.5 < norm < 2 or not all(map(math.isfinite, position)):
        raise NoTransform(f"({', '.join(f'{part:g}' for part in rotation)}) is no rotation")
    x, y, z = position
    qx, qy, qz, qw = (part / norm for part in rotation)
    return Transform((x, y, z), (qx, qy, qz, qw))


def between(a: Transform, b: Transform, share: float) -> Transform:
    """Return the transform at `share` of the way from a to b: straight, and turning evenly (slerp, Shoemake 1985)."""
    x, y, z = (p + share * (q - p) for p, q in zip(a.position, b.position, strict=True))
    dot = sum(p * q for p, q in zip(a.rotation, b.rotation, strict=True))
    sign = 1.0 if dot >= 0 else -1.0
    dot = abs(dot)
    if dot > _NEARLY_EQUAL:
        of_a, of_b = 1 - share, share
    else:
        angle = math.acos(dot)
        of_a = math.sin((1 - share) * angle) / math.sin(angle)
        of_b = math.sin(share * angle) / math.sin(angle)
    mixed = [of_a * p + sign * of_b * q for p, q in zip(a.rotation, b.rotation, strict=True)]
    return transform((x, y, z), mixed)


class Edge:
    """parent_from_child over time, or for all time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self._times: list[int] = []
        self._transforms: list[Transform] = []
        self._is_static = False

    def add(self, stamp: int, parent_from_child: Transform, *, is_static: bool) -> None:
        """Note a message; they may come in any order."""
        if is_static:
            self._is_static, self._times, self._transforms = True, [stamp], [parent_from_child]
            return
        at = bisect.bisect(self._times, stamp)
        self._times.insert(at, stamp)
        self._transforms.insert(at, parent_from_child)

    def at(self, stamp: int) -> Transform:
        """Return parent_from_child at a time, nanoseconds. Raises NoTransform outside of what was recorded."""
        if self._is_static:
            return self._transforms[0]
        after = bisect.bisect_left(self._times, stamp)
        if after == len(self._times) or (after == 0 and self._times[0] != stamp):
            nearest = self._times[-1] if after else self._times[0]
            if abs(nearest - stamp) > REACH_NS:
                raise NoTransform(f"{abs(nearest - stamp) / 1e9:.2f} s outside of what was recorded")
            return self._transforms[-1 if after else 0]
        if self._times[after] == stamp:
            return self._transforms[after]
        gap = self._times[after] - self._times[after - 1]
        if gap > GAP_NS:
            raise NoTransform(f"in a gap of {gap / 1e9:.1f} s")
        share = (stamp - self._times[after - 1]) / gap
        return between(self._transforms[after - 1], self._transforms[after], share)


class TransformTree:
    """Every frame with the one that it hangs on."""

    def __init__(self) -> None:
        self._edges: dict[str, Edge] = {}

    def add(
        self, parent: str, child: str, stamp: int, parent_from_child: Transform, *, is_static: bool = False
    ) -> None:
        """Note what a message says. A frame that changes its parent hangs on the newer one, as in tf2."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            edge = self._edges[child] = Edge(parent)
        edge.add(stamp, parent_from_child, is_static=is_static)

    def drop(self, child: str) -> None:
        """Forget on what a frame hangs."""
        self._edges.pop(child.lstrip("/"), None)

    def frames(self) -> list[str]:
        """Return the names of all frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def lookup(self, target: str, source: str, stamp: int) -> Transform:
        """Return target_from_source at a time, nanoseconds. Raises NoTransform."""
        of_source, of_target = self._ancestors(source), self._ancestors(target)
        shared = next((frame for frame in of_source if frame in of_target), None)
        if shared is None:
            raise NoTransform(
                f"no frame joins {source!r} and {target!r}; there are {', '.join(self.frames())}"
            )
        shared_from_source = self._to_ancestor(of_source, shared, stamp)
        shared_from_target = self._to_ancestor(of_target, shared, stamp)
        return shared_from_target.inverse() @ shared_from_source

    def _ancestors(self, frame: str) -> list[str]:
        """Return a frame, what it hangs on, and so on up to the root."""
        chain = [frame]
        while (edge := self._edges.get(chain[-1])) is not None and edge.parent not in chain:
            chain.append(edge.parent)
        return chain

    def _to_ancestor(self, chain: list[str], ancestor: str, stamp: int) -> Transform:
        ancestor_from_frame = IDENTITY
        for frame in chain[: chain.index(ancestor)]:
            try:
                ancestor_from_frame = self._edges[frame].at(stamp) @ ancestor_from_frame
            except NoTransform as error:
                raise NoTransform(f"{self._edges[frame].parent} from {frame}: {error}") from error
        return ancestor_from_frame


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return Hamilton's product, x y z w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _rotated(rotation: Quaternion, vector: Vector) -> Vector:
    x, y, z, w = rotation
    rx, ry, rz, _ = _product(_product(rotation, (*vector, 0.0)), (-x, -y, -z, w))
    return rx, ry, rz
