"""Shapes: whether what went and what came is one thing that was moved, and how.

Two visits see different sides of a thing, and of one that was moved by less than its own size only the parts that lie
outside the other place have changed. So shapes are laid upon each other in many ways, and a good part has to fit: on
what changed, or where the two places may overlap on what the other visit could not judge.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import KDTree

from worker.cloud.settings import StrictModel
from worker.cloud.types import Bools, Floats, Points
from worker.pipeline.results.places import around

TOLERANCE = 0.075  #: metres; voxels this near are the same: one and a half
YAWS = (
    24  #: turns that are tried, or half as many, with three shifts each, where two places are near each other
)
SHARES = (0.33, 0.67, 1.0)  #: of the way between the two: those shifts
AS_GOOD = 0.1  #: of overlap: of motions that fit as well, the least is taken
ROUND = 0.1  #: of overlap that no turn loses, where a shape is round
PER_METRE = (0.1, 1.0)  #: of overlap that a metre of way weighs, level and up: things are seldom carried far
RIVAL = 0.05  #: of overlap and way together: a second pair as good as that leaves it open which is right
BELONGS = 0.6  #: of a further region, that the motion lays upon the thing: then it is a part of it
FRAGMENT = 0.08  #: of the larger of two shapes; a smaller one fits anywhere, and proves nothing
_NEAR = (1.5, 1.0)  # times the larger size, or metres, between two places that may overlap
_COARSE, _FINE, _KEPT = 64, 250, 6  # points a shape, and poses that are refined
_COARSE_REACHES, _FINE_REACHES = (0.5, 0.3, 0.2), (0.15, 0.1)  # metres to a partner, step by step
_HOPELESS = 0.3  # of overlap after the coarse steps; with less no fine ones are tried
_MOST_TURN = 0.15  # radians a step
_LAST_REACHES = (0.1,) * 10  # sides that slide on each other take many steps
_SAME_YAW, _SAME_SHIFT = np.radians(20), 0.15  # poses that come to rest at the same

Vector3 = tuple[float, float, float]


class ShapeSettings(StrictModel):
    """When a thing that went and one that came are the same."""

    max_distance: float = Field(6.0, gt=0, description="metres that a thing is moved at most")
    max_rise: float = Field(0.3, ge=0, description="metres that its lower side is moved up or down at most")
    min_likeness: float = Field(
        0.65, gt=0, le=1, description="of each side of the box, the smaller of the larger"
    )
    min_overlap: float = Field(
        0.4,
        gt=0,
        le=1,
        description="intersection over union of the two, laid on each other, less 0.1 a metre of way",
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """How a thing was moved, now_from_before: turned about the upright axis through its earlier centre, then shifted."""

    translation: Vector3  #: metres, map frame
    yaw: float | None  #: radians, counter-clockwise, -pi to pi; None: the shape is round
    overlap: float  #: intersection over union of the two shapes, laid upon each other, 0..1


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Shape:
    """What went or came."""

    points: Floats  #: (n, 3) metres, map frame: of the changed voxels
    center: Vector3  #: of its box
    size: Vector3  #: of its box: two sides that lie level, then the height

    @property
    def bottom(self) -> float:
        return self.center[2] - self.size[2] / 2


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Surroundings:
    """What one visit saw."""

    points: Points  #: (V, 3) metres, map frame, one a voxel, in the order of the voxels' keys
    unjudged: Bools  #: (V,) what the other visit could not judge
    voxel_size: float  #: metres

    def within(self, low: Floats, high: Floats) -> Floats:
        """Return the points (n, 3) in a box."""
        return self._boxed(low, high)[0]

    def hidden(self, low: Floats, high: Floats) -> Floats:
        """Return the points (n, 3) in a box that the other visit could not judge."""
        points, unjudged = self._boxed(low, high)
        return points[unjudged]

    def _boxed(self, low: Floats, high: Floats) -> tuple[Floats, Bools]:
        rows = around(self.points, low[0], high[0], voxel_size=self.voxel_size)
        points = self.points[rows].astype(np.float64)
        inside = np.all((points >= low) & (points <= high), axis=1)
        return points[inside], self.unjudged[rows][inside]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Moved:
    """A thing that was moved, in pieces: rows of what went and of what came, the main ones first."""

    gone: tuple[int, ...]
    come: tuple[int, ...]
    fit: Fit

    def motion_of(self, center: Vector3) -> Motion:
        """Return how the thing was moved whose box had this centre before."""
        return self.fit.motion_of(np.asarray(center))


def moved_things(
    gone: Sequence[Shape],
    come: Sequence[Shape],
    visits: tuple[Surroundings, Surroundings],
    settings: ShapeSettings,
) -> list[Moved]:
    """Return which of those gone is which of those that came; the visits are the one before and the one now.

    Each shape is in one thing at most. A pair that has a rival about as good is left out.
    """
    pairs = [
        (a, b) for a, before in enumerate(gone) for b, now in enumerate(come) if _alike(before, now, settings)
    ]
    with ThreadPoolExecutor(2) as pool:  # the trees let each other run
        laid = pool.map(lambda pair: Fit.of(gone[pair[0]], come[pair[1]], visits), pairs)
    fits = dict(zip(pairs, laid, strict=True))
    fits = {pair: fit for pair, fit in fits.items() if fit.merit >= settings.min_overlap}
    things: list[Moved] = []
    taken_gone: set[int] = set()
    taken_come: set[int] = set()
    for a, b in sorted(fits, key=lambda pair: -fits[pair].weight):
        fit = fits[a, b]
        free = {
            pair: each
            for pair, each in fits.items()
            if pair[0] not in taken_gone and pair[1] not in taken_come
        }
        rivals = [each for pair, each in free.items() if (pair[0] == a) != (pair[1] == b)]
        if (a, b) not in free or any(rival.as_good_as(fit) for rival in rivals):
            continue
        more_gone, more_come = fit.pieces(gone, come)
        thing = Moved(
            gone=(a, *(row for row in more_gone if row != a and row not in taken_gone)),
            come=(b, *(row for row in more_come if row != b and row not in taken_come)),
            fit=fit,
        )
        things.append(thing)
        taken_gone.update(thing.gone)
        taken_come.update(thing.come)
    return things


def _alike(before: Shape, now: Shape, settings: ShapeSettings) -> bool:
    """Tell whether two shapes are near enough and of like size to be worth laying upon each other."""
    way = np.subtract(now.center, before.center)
    fewer, more = sorted((len(before.points), len(now.points)))
    if np.hypot(way[0], way[1]) > settings.max_distance or fewer < FRAGMENT * more:
        return False
    if _near(before, now):
        return True
    sizes = np.array([[*sorted(shape.size[:2]), shape.size[2]] for shape in (before, now)])
    sizes = np.maximum(sizes, 2 * TOLERANCE)  # what is thinner is as good as that
    like = bool((sizes.min(axis=0) / sizes.max(axis=0) >= settings.min_likeness).all())
    return like and abs(now.bottom - before.bottom) <= settings.max_rise


def _near(before: Shape, now: Shape) -> bool:
    """Tell whether the two places may overlap, so that only parts of the thing have changed."""
    way = np.subtract(now.center, before.center)
    size = max(*before.size[:2], *now.size[:2])
    return bool(np.hypot(way[0], way[1]) < max(_NEAR[0] * size, _NEAR[1]))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Fit:
    """One shape laid on another, in the best way."""

    pose: _Poses  #: one
    center: Floats  #: (3,) of the thing before
    is_round: bool
    overlap: float
    voxels: float  #: that lie upon each other, of both
    pair: _Pair  #: as the last pose was judged

    @classmethod
    def of(cls, before: Shape, now: Shape, visits: tuple[Surroundings, Surroundings]) -> Fit:
        """Lay one shape on the other in every way, and take the least motion of those that fit best."""
        near = _near(before, now)
        trees = tuple(
            KDTree(_with_surroundings(shape, visit, before, now) if near else shape.points)
            for shape, visit in zip((before, now), visits, strict=True)
        )
        middle = before.points.mean(axis=0)
        way = now.points.mean(axis=0) - middle
        if near:
            way[2] = 0.0  # of parts of a thing, which may be of different heights
        turns = YAWS // 2 if near else YAWS
        shares = np.array(SHARES) if near else np.ones(1)
        poses = _Poses(
            yaws=np.tile(_halved(np.arange(turns) * 2 * np.pi / turns), len(shares)),
            shifts=np.repeat(shares, turns)[:, None] * way,
            middle=middle,
        )
        coarse = _Pair(
            before=_thinned(before.points, _COARSE), now=_thinned(now.points, _COARSE), trees=trees
        )
        poses = coarse.refined(poses, _COARSE_REACHES)
        overlaps = coarse.overlaps(poses)
        is_round = not near and bool(overlaps.min() > overlaps.max() - ROUND)
        best = np.argsort(-overlaps, kind="stable")[:_KEPT]
        fine = _Pair(before=_thinned(before.points, _FINE), now=_thinned(now.points, _FINE), trees=trees)
        if overlaps.max() < _HOPELESS:
            poses = poses.subset(best[:1])
        else:
            poses = fine.refined(poses.subset(best), _FINE_REACHES)
            poses = fine.refined(poses.subset(poses.least(fine.overlaps(poses))), _LAST_REACHES)
        first, second = (float(share[0]) for share in fine.shares(poses))
        both = (first + second) / 2
        return cls(
            pose=poses,
            center=np.asarray(before.center),
            is_round=is_round,
            overlap=both / (2 - both),
            voxels=first * len(before.points) + second * len(now.points),
            pair=fine,
        )

    def motion_of(self, center: Floats) -> Motion:
        """Return how a thing with this centre (3,) was moved: of turns that fit as well, by the least."""
        shift = self._shift(center)
        yaws = _halved(self.pose.yaws + np.array([0.0, 0.5, 1.0, 1.5]) * np.pi)
        overlaps = self.pair.overlaps(_Poses(yaws=yaws, shifts=np.tile(shift, (4, 1)), middle=center))
        yaw = min(yaws[overlaps >= overlaps.max() - AS_GOOD], key=abs)
        x, y, z = (round(float(value), 3) for value in shift)
        return Motion(translation=(x, y, z), yaw=None if self.is_round else float(yaw), overlap=self.overlap)

    def _shift(self, center: Floats) -> Floats:
        shift: Floats = self.pose.applied(center[None])[0, 0] - center
        return shift

    @property
    def merit(self) -> float:
        """The overlap, less what the way weighs."""
        x, y, z = self._shift(self.center)
        return self.overlap - PER_METRE[0] * float(np.hypot(x, y)) - PER_METRE[1] * abs(float(z))

    @property
    def weight(self) -> float:
        """How much the fit explains: what decides first."""
        return self.merit * float(np.sqrt(self.voxels))

    def as_good_as(self, other: Fit) -> bool:
        return self.merit > other.merit - RIVAL and self.weight > 0.7 * other.weight

    def pieces(self, gone: Sequence[Shape], come: Sequence[Shape]) -> tuple[list[int], list[int]]:
        """Return the rows of all shapes that the motion lays upon the thing: of those gone, of those that came."""
        ours = [
            row
            for row, shape in enumerate(gone)
            if self._lands(1, self.pose.applied(shape.points)[0]) >= BELONGS
        ]
        theirs = [
            row
            for row, shape in enumerate(come)
            if self._lands(0, self.pose.undone(shape.points)[0]) >= BELONGS
        ]
        return ours, theirs

    def _lands(self, side: int, points: Floats) -> float:
        """Return the share of points (n, 3) that lie on what there is on a side."""
        distances, _ = self.pair.trees[side].query(points, distance_upper_bound=TOLERANCE)
        return float(np.isfinite(distances).mean())


def _with_surroundings(shape: Shape, visit: Surroundings, before: Shape, now: Shape) -> Floats:
    """Return a shape with what else may be of the thing: all between both places, and around them what was hidden."""
    both = np.concatenate([before.points, now.points])
    margin = np.array([*[max(*before.size[:2], *now.size[:2]) / 2] * 2, 0.0])
    low, high = both.min(axis=0), both.max(axis=0)
    return np.concatenate([shape.points, visit.hidden(low - margin, high + margin), visit.within(low, high)])


def _thinned(points: Floats, most: int) -> Floats:
    """Return at most so many of the points (n, 3), evenly."""
    return points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(np.intp)]


def _halved(angles: Floats) -> Floats:
    """Return the same angles from -pi to pi."""
    halved: Floats = (angles + np.pi) % (2 * np.pi) - np.pi
    return halved


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Poses:
    """H ways to lay a shape on another: turned by yaws (H,) about the middle (3,), then shifted by (H, 3) metres."""

    yaws: Floats
    shifts: Floats
    middle: Floats
    turns: Floats = field(init=False)  #: (H, 3, 3)

    def __post_init__(self) -> None:
        cosines, sines = np.cos(self.yaws), np.sin(self.yaws)
        turns = np.zeros((len(self.yaws), 3, 3))
        turns[:, 0, 0] = turns[:, 1, 1] = cosines
        turns[:, 1, 0], turns[:, 0, 1], turns[:, 2, 2] = sines, -sines, 1.0
        object.__setattr__(self, "turns", turns)

    def applied(self, points: Floats) -> Floats:
        """Return (H, n, 3)."""
        placed: Floats = np.einsum("hij,nj->hni", self.turns, points - self.middle)
        return placed + (self.middle + self.shifts)[:, None]

    def undone(self, points: Floats) -> Floats:
        """Return (H, n, 3)."""
        away = points[None] - (self.middle + self.shifts)[:, None]
        placed: Floats = np.einsum("hji,hnj->hni", self.turns, away)
        return placed + self.middle

    def subset(self, chosen: NDArray[np.intp]) -> _Poses:
        return _Poses(yaws=self.yaws[chosen], shifts=self.shifts[chosen], middle=self.middle)

    def least(self, overlaps: Floats) -> NDArray[np.intp]:
        """Return (1,) the row of the least motion that is as good as any: half a turn weighs as much as a metre.

        Of poses near it that are on their way to the same end, it is the best.
        """
        motions = np.abs(_halved(self.yaws)) / np.pi + np.linalg.norm(self.shifts, axis=1)
        row = int(np.where(overlaps >= overlaps.max() - AS_GOOD, motions, np.inf).argmin())
        alike = np.abs(_halved(self.yaws - self.yaws[row])) < _SAME_YAW
        alike &= np.linalg.norm(self.shifts - self.shifts[row], axis=1) < _SAME_SHIFT
        return np.array([np.where(alike, overlaps, -np.inf).argmax()])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Pair:
    """Points of both shapes (n, 3), (m, 3), and the trees of what each may come to lie on: those before, those now."""

    before: Floats
    now: Floats
    trees: tuple[KDTree, ...]

    def refined(self, poses: _Poses, reaches: Sequence[float]) -> _Poses:
        """Bring each pose nearer by ICP with partners both ways, of upright motions only."""
        for reach in reaches:
            there, back = poses.applied(self.before), poses.undone(self.now)
            forward = self._partners(1, there, reach) - there
            backward = np.einsum("hij,hnj->hni", poses.turns, back - self._partners(0, back, reach))
            at = np.concatenate([there, np.broadcast_to(self.now, back.shape)], axis=1)
            poses = _stepped(poses, at, np.concatenate([forward, backward], axis=1))
        return poses

    def shares(self, poses: _Poses) -> tuple[Floats, Floats]:
        """Return (H,) twice: the share of each shape that comes to lie on the other."""
        first = self._partners(1, poses.applied(self.before), TOLERANCE)
        second = self._partners(0, poses.undone(self.now), TOLERANCE)
        return (
            np.isfinite(first[:, :, 0]).mean(axis=1),
            np.isfinite(second[:, :, 0]).mean(axis=1),
        )

    def overlaps(self, poses: _Poses) -> Floats:
        """Return (H,) the intersection over union."""
        first, second = self.shares(poses)
        both = (first + second) / 2
        overlaps: Floats = both / (2 - both)
        return overlaps

    def _partners(self, side: int, points: Floats, reach: float) -> Floats:
        """Return (H, n, 3) the nearest target of each point; NaN where none is within reach."""
        tree = self.trees[side]
        _, rows = tree.query(points.reshape(-1, 3), distance_upper_bound=reach)
        there = rows < tree.n
        found = np.full((len(rows), 3), np.nan)
        found[there] = tree.data[rows[there]]
        return found.reshape(points.shape)


def _stepped(poses: _Poses, at: Floats, residuals: Floats) -> _Poses:
    """Shift and turn each pose by the least squares of its residuals (H, k, 3); NaN ones do not count."""
    known = np.isfinite(residuals[:, :, 0])
    count = np.maximum(known.sum(axis=1), 1)
    gaps = np.where(known[:, :, None], residuals, 0.0)
    shift = gaps.sum(axis=1) / count[:, None]
    center = np.where(known[:, :, None], at, 0.0).sum(axis=1) / count[:, None]
    arms = np.where(known[:, :, None], at - center[:, None], 0.0)
    torque = (arms[:, :, 0] * gaps[:, :, 1] - arms[:, :, 1] * gaps[:, :, 0]).sum(axis=1)
    turn = np.clip(torque / np.maximum((arms[:, :, :2] ** 2).sum(axis=(1, 2)), 1e-6), -_MOST_TURN, _MOST_TURN)
    turned = _Poses(yaws=turn, shifts=np.zeros((len(turn), 3)), middle=np.zeros(3)).turns
    # about the partners' centre: where the poses' own middle comes to lie
    arm = poses.middle + poses.shifts - center
    shifts = np.einsum("hij,hj->hi", turned, arm) + center + shift - poses.middle
    return _Poses(yaws=poses.yaws + turn, shifts=shifts, middle=poses.middle)
