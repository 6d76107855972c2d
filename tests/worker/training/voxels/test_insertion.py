"""Solids in hand-made scans: where rays meet them, what is behind, where they fit, and what samples say of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from worker.cloud.seen import Seen
from worker.cloud.types import Floats, Points
from worker.cloud.voxels import Voxels
from worker.detectors.voxels.evidence import EvidenceSettings
from worker.training.voxels.insertion import (
    FreeRoom,
    InsertedScan,
    SiteSettings,
    compared,
    inserted,
    missing_labels,
    random_solids,
    site_samples,
)
from worker.training.voxels.samples import MISSING, THERE, UNKNOWN
from worker.training.voxels.solids import Box, CloudObject, Cylinder, Solid, Union, chair, table

HERE = np.zeros(3)
EVIDENCE = EvidenceSettings()


def ahead(*directions: tuple[float, float, float]) -> Floats:
    rays = np.array(directions, np.float64)
    return rays / np.linalg.norm(rays, axis=1)[:, None]


def told(solid: Solid, *directions: tuple[float, float, float]) -> list[float]:
    return solid.ranges(HERE, ahead(*directions)).tolist()


@dataclass(frozen=True)
class Placed:
    points: Points
    sensor_origin: Floats | None


def room_scan(origin: tuple[float, float, float], *, step: float = 0.6, seed: int = 0) -> Placed:
    """Look from a place in a room of 6 x 5 x 2.6 m, in all directions `step` degrees apart, with 5 mm of noise."""
    azimuth, elevation = (
        axis.ravel()
        for axis in np.meshgrid(
            np.arange(0, 2 * np.pi, np.radians(step)), np.radians(np.arange(-80, 80, step))
        )
    )
    flat = np.cos(elevation)
    rays = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)
    place = np.array(origin)
    with np.errstate(divide="ignore"):
        walls = np.concatenate(
            [(np.zeros(3) - place) / rays, (np.array([6.0, 5.0, 2.6]) - place) / rays], axis=1
        )
    ranges = np.where(walls > 1e-9, walls, np.inf).min(axis=1)
    ranges += np.random.default_rng(seed).normal(0, 0.005, len(ranges))
    return Placed((place + rays * ranges[:, None]).astype(np.float32), place)


@pytest.fixture(scope="module")
def scans() -> list[Placed]:
    return [
        room_scan((1.5, 1.5, 1.0), step=1.2, seed=1),
        room_scan((4.5, 3.5, 1.0), step=1.2, seed=2),
        room_scan((3.0, 2.5, 1.0), step=1.2, seed=3),
    ]


def test_rays_meet_a_box_where_its_faces_are() -> None:
    box = Box(middle=np.array([3.0, 0.0, 0.0]), half=np.array([0.5, 1.0, 0.2]))
    assert told(box, (1, 0, 0), (-1, 0, 0), (0, 1, 0)) == [2.5, np.inf, np.inf]
    assert told(box, (2.5, 0.9, 0)) == pytest.approx([np.hypot(2.5, 0.9)])
    assert told(box, (2.5, 1.1, 0)) == [np.inf]  # passes beside it
    assert box.ranges(np.array([3.0, 0.0, 0.0]), ahead((1, 0, 0))).tolist() == [np.inf]  # from within


def test_a_turned_box_turns_its_corner_to_the_ray() -> None:
    box = Box(middle=np.array([3.0, 0.0, 0.0]), half=np.array([0.5, 0.5, 0.5]), yaw=np.pi / 4)
    assert told(box, (1, 0, 0)) == pytest.approx([3 - np.sqrt(0.5)])


def test_rays_meet_a_cylinder_at_its_mantle_and_at_its_ends() -> None:
    post = Cylinder(middle=np.array([2.0, 0.0, 0.0]), girth=0.3, half_height=0.5)
    beside = 0.2  # metres off the axis
    depth = 2 - np.sqrt(0.3**2 - beside**2)
    assert told(post, (1, 0, 0), (depth, beside, 0)) == pytest.approx([1.7, np.hypot(depth, beside)])
    assert told(post, (0, 0, 1), (2, 0.4, 0), (-1, 0, 0)) == [np.inf, np.inf, np.inf]
    above = np.array([2.0, 0.1, 3.0])
    assert post.ranges(above, ahead((0, 0, -1))).tolist() == [2.5]  # straight down on its top
    assert post.ranges(np.array([2.0, 0.4, 3.0]), ahead((0, 0, -1))).tolist() == [np.inf]


def test_a_union_is_met_where_its_nearest_part_is() -> None:
    box = Box(middle=np.array([3.0, 0.0, 0.0]), half=np.array([0.5, 1.0, 0.2]))
    post = Cylinder(middle=np.array([2.0, 0.0, 0.0]), girth=0.1, half_height=0.5)
    both = Union(parts=(box, post))
    assert told(both, (1, 0, 0), (2.5, 0.9, 0)) == pytest.approx([1.9, np.hypot(2.5, 0.9)])
    for part in (box, post):
        assert np.linalg.norm(part.middle - both.middle) + part.radius <= both.radius + 1e-9


def test_under_a_table_one_sees_through_between_its_legs() -> None:
    stood = table(np.array([2.0, 0.0, 0.0]), np.array([1.0, 1.0, 0.8]), yaw=0.0)
    assert told(stood, (1, 0, 0)) == [np.inf]
    assert told(stood, (1.5, 0, 0.38)) == pytest.approx([np.hypot(1.5, 0.38)])
    assert told(stood, (1.5, 0.48, 0)) == pytest.approx([np.hypot(1.5, 0.48)])  # a leg
    seat = chair(
        np.array([2.0, 0.0, 0.0]), np.array([0.5, 0.5, 0.9]), yaw=np.pi
    )  # its back away from the sensor
    assert told(seat, (2.2, 0, 0.3)) == pytest.approx([2.2 * np.hypot(1, 0.3 / 2.2)])


@pytest.mark.parametrize(
    "solid",
    [
        Box(middle=np.array([1.0, 2.0, 3.0]), half=np.array([0.5, 0.2, 0.1]), yaw=0.7),
        Cylinder(middle=np.array([1.0, 2.0, 3.0]), girth=0.4, half_height=0.2),
        table(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.6, 0.8]), yaw=0.3),
    ],
)
def test_a_solid_holds_its_own_places_and_none_beyond_its_sphere(solid: Solid) -> None:
    places = solid.places()
    assert solid.holds(places, 1e-9).all()
    assert (np.linalg.norm(places - solid.middle, axis=1) <= solid.radius + 1e-9).all()
    far = solid.middle + np.array([[0.0, 0.0, solid.radius + 0.1]])
    assert not solid.holds(far).any()
    assert solid.holds(far, margin=2 * solid.radius).all()


def plate(x: float, half: float, step: float) -> Floats:
    steps = np.arange(-half, half + step / 2, step)
    y, z = (axis.ravel() for axis in np.meshgrid(steps, steps))
    return np.stack([np.full(len(y), x), y, z], axis=1)


def test_a_cloud_is_met_where_its_points_are_and_has_no_holes_between_them() -> None:
    cloud = CloudObject.of(plate(2.0, 0.3, 0.03))  # points two cells apart
    rays = ahead(*[(2.0, y, z) for y in np.linspace(-0.28, 0.28, 57) for z in np.linspace(-0.28, 0.28, 57)])
    ranges = cloud.ranges(HERE, rays)
    assert np.abs(ranges * rays[:, 0] - 2.0).max() < 0.01
    assert told(cloud, (2, 0.36, 0), (2, 0, -0.36), (-1, 0, 0)) == [np.inf] * 3


def test_between_the_lines_of_a_scanner_one_does_not_see_through_if_their_spacing_is_said() -> None:
    lines = plate(2.0, 0.3, 0.01)
    lines = lines[np.abs(np.round(lines[:, 2] / 0.06) * 0.06 - lines[:, 2]) < 1e-6]  # 6 cm from line to line
    rays = ahead(*[(2.0, 0.0, z) for z in np.linspace(-0.28, 0.28, 57)])
    assert np.isinf(CloudObject.of(lines).ranges(HERE, rays)).any()
    assert np.isfinite(CloudObject.of(lines, spacing=0.06).ranges(HERE, rays)).all()


def test_what_lies_behind_a_cloud_does_not_shine_through_its_holes() -> None:
    cloud = CloudObject.of(np.concatenate([plate(2.0, 0.3, 0.03), plate(2.4, 0.2, 0.03)]))
    rays = ahead(*[(2.0, y, z) for y in np.linspace(-0.15, 0.15, 41) for z in np.linspace(-0.15, 0.15, 41)])
    assert (cloud.ranges(HERE, rays) < 2.1).all()


def test_a_cloud_moves_to_a_place_and_turns() -> None:
    cloud = CloudObject.of(plate(2.0, 0.3, 0.03) + np.array([0.0, 5.0, 0.0]))
    moved = cloud.moved(np.array([1.0, 0.0, 0.0]), yaw=np.pi / 2)
    assert moved.half == pytest.approx([0.3, 0.0, 0.3], abs=1e-9)
    assert (moved.points.min(axis=0) + moved.points.max(axis=0)) / 2 == pytest.approx([1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="1 points"):
        CloudObject.of(np.zeros((1, 3)))


def test_a_return_behind_a_solid_comes_from_the_solid_and_the_others_stay() -> None:
    wall = np.array([[4.0, 0.0, 0.0], [4.0, 1.0, 0.0], [1.0, 0.0, 0.0], [-4.0, 0.0, 0.0], [2.51, 0.0, 0.0]])
    box = Box(middle=np.array([3.0, 0.0, 0.0]), half=np.array([0.5, 0.5, 0.2]))
    points, owner = inserted(wall, HERE, [box], np.random.default_rng(0), range_sigma=0.0)
    # beyond it; past its side; before it; behind the sensor; a centimetre within its face, as noise has it
    assert owner.tolist() == [0, -1, -1, -1, -1]
    assert points.dtype == np.float32
    assert points[0] == pytest.approx([2.5, 0, 0])
    assert np.array_equal(points[1:], wall[1:].astype(np.float32))


def test_the_nearest_of_several_solids_is_hit_and_nothing_behind_it() -> None:
    scan = room_scan((3.0, 2.5, 1.0))
    near = Box(middle=np.array([4.5, 2.5, 1.0]), half=np.array([0.1, 0.3, 0.3]))
    far = Cylinder(middle=np.array([5.5, 2.5, 1.0]), girth=0.2, half_height=0.3)
    points, owner = inserted(scan.points, np.array([3.0, 2.5, 1.0]), [far, near], np.random.default_rng(0))
    assert (owner == 1).sum() > 200
    assert not (owner == 0).any()  # it stands in the other's shadow
    behind = (points[:, 0] > 4.7) & (np.abs(points[:, 1] - 2.5) < 0.28) & (np.abs(points[:, 2] - 1.0) < 0.28)
    assert not behind.any()


def test_returns_on_a_solid_have_the_noise_that_was_asked_for() -> None:
    origin = np.array([3.0, 2.5, 1.0])
    scan = room_scan((3.0, 2.5, 1.0), step=0.3)
    box = Box(middle=np.array([4.6, 2.5, 1.0]), half=np.array([0.1, 0.4, 0.4]))
    points, owner = inserted(scan.points, origin, [box], np.random.default_rng(0), range_sigma=0.02)
    rays = points[owner == 0] - origin
    lengths = np.linalg.norm(rays, axis=1)
    off = lengths - box.ranges(origin, rays / lengths[:, None].astype(np.float64))
    assert off.std() == pytest.approx(0.02, rel=0.1)
    assert off.mean() == pytest.approx(0.0, abs=0.002)


def test_a_thing_fits_into_free_room_and_not_into_others_or_out_of_sight(scans: list[Placed]) -> None:
    room = FreeRoom(scans)
    half = np.array([0.2, 0.2, 0.2])
    assert room.fits(Box(middle=np.array([2.0, 3.5, 1.3]), half=half), bottom=None)
    assert room.fits(Box(middle=np.array([2.0, 3.5, 0.2]), half=half), bottom=0.0)
    assert not room.fits(
        Box(middle=np.array([2.0, 3.5, 0.2]), half=half), bottom=None
    )  # the floor is in its way
    assert not room.fits(Box(middle=np.array([0.1, 3.5, 1.3]), half=half), bottom=None)  # the wall is
    assert not room.fits(Box(middle=np.array([-2.0, 3.5, 1.3]), half=half), bottom=None)  # behind it
    assert not room.fits(Box(middle=np.array([3.0, 2.5, 1.5]), half=half), bottom=None)  # on top of a sensor
    assert room.support(np.array([2.0, 3.5, 1.3]), 0.2) == pytest.approx(0.0, abs=0.03)
    with pytest.raises(ValueError, match="no scan has a sensor's place"):
        FreeRoom([Placed(scans[0].points, None)])


def test_random_solids_are_in_sight_and_clear_of_what_stands_there(scans: list[Placed]) -> None:
    solids = random_solids(scans, np.random.default_rng(5), 6)
    assert len(solids) >= 4
    everything = np.concatenate([scan.points for scan in scans])
    clear = everything[everything[:, 2] > 0.06]
    for number, solid in enumerate(solids):
        assert not solid.holds(clear).any()
        taken = sum(
            (inserted(scan.points, scan.sensor_origin, [solid], np.random.default_rng(0))[1] == 0).sum()
            for scan in scans
            if scan.sensor_origin is not None
        )
        assert taken >= 30, number
    again = random_solids(scans, np.random.default_rng(5), 6)
    assert [solid.middle.tolist() for solid in again] == [solid.middle.tolist() for solid in solids]


def test_things_of_other_scans_are_put_in_as_well(scans: list[Placed]) -> None:
    thing = CloudObject.of(plate(2.0, 0.2, 0.02))
    solids = random_solids(scans, np.random.default_rng(1), 8, things=[thing])
    assert any(isinstance(solid, CloudObject) for solid in solids)


def test_labels_say_what_is_on_a_solid_and_where_nobody_can_tell(scans: list[Placed]) -> None:
    rng = np.random.default_rng(0)
    box = Box(middle=np.array([3.0, 4.0, 0.25]), half=np.array([0.2, 0.2, 0.25]))  # stands on the floor
    visit = [InsertedScan.of(scan, [box], rng) for scan in scans]
    own, other = Seen.of(visit, voxel_size=0.05), Seen.of(scans, voxel_size=0.05)
    truth = missing_labels(visit, own, other)
    on_box = box.holds(own.points, 0.03)
    high = own.points[:, 2] > 0.15
    assert (truth[on_box & high] == MISSING).mean() > 0.98
    assert (truth[~box.holds(own.points, 0.06)] == THERE).all()
    assert set(truth[on_box & (own.points[:, 2] < 0.04)].tolist()) <= {UNKNOWN, THERE}
    sizes = {
        tuple(np.unique(sample.labels))
        for sample in compared(visit, [_bare(scan) for scan in scans], 0.05, EVIDENCE)
    }
    assert any(MISSING in labels for labels in sizes)


def _bare(scan: Placed) -> InsertedScan:
    return InsertedScan.of(scan, [], np.random.default_rng(0))


@pytest.mark.parametrize("count", [1, 3])
def test_a_sites_own_scans_make_samples(scans: list[Placed], count: int) -> None:
    site = SiteSettings(rounds=5, solids=4)
    samples = site_samples(scans[:count], 0.05, EVIDENCE, np.random.default_rng(2), site=site)
    seeing = [sample for sample in samples if sample.free_space]
    assert 0 < len({sample.building for sample in samples}) <= 5
    labels, through = (
        np.concatenate(parts) for parts in zip(*((s.labels, s.channels[:, 2]) for s in seeing), strict=True)
    )
    assert (labels == MISSING).sum() > 50
    assert (labels == THERE).sum() > 100
    assert through[labels == MISSING].mean() > 3 * through[labels == THERE].mean()
    again = site_samples(scans[:count], 0.05, EVIDENCE, np.random.default_rng(2), site=site)
    assert all(np.array_equal(a.labels, b.labels) for a, b in zip(samples, again, strict=True))


def test_scans_without_a_sensors_place_stay_as_they_are(scans: list[Placed]) -> None:
    blind = [Placed(scan.points, None) for scan in scans]
    samples = site_samples(blind, 0.05, EVIDENCE, np.random.default_rng(0), site=SiteSettings(rounds=3))
    assert all(not sample.free_space and (sample.labels != MISSING).all() for sample in samples)
    keys = Voxels.keys_of(scans[0].points, size=0.05)
    box = Box(middle=np.array([3.0, 4.0, 0.25]), half=np.array([0.2, 0.2, 0.25]))
    left = InsertedScan.of(blind[0], [box], np.random.default_rng(0))
    assert np.array_equal(Voxels.keys_of(left.points, size=0.05), keys)
    assert (left.owner == -1).all()
