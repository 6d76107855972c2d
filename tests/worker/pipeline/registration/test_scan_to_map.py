from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from tests.support.rooms import Room, as_scan
from worker.cloud.formats.scan import Scan, read_scan
from worker.cloud.poses import difference, exponential, transformed
from worker.cloud.types import Points
from worker.cloud.voxels import Voxels
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.scan_to_map import register, registration_result
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, least_eigenvalue, surface_of
from worker.simulation.scenes import random_room, small_office
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

SETTINGS = RegistrationSettings()
#: where a search is to find nothing, one draw instead of six says so as well, and six times as fast
ONE_DRAW = SETTINGS.model_copy(update={"search_resolutions": (0.3,), "search_seeds": 1})


def _ready(scan: Scan | Points, settings: RegistrationSettings = SETTINGS) -> PreparedScan:
    return prepare(scan if isinstance(scan, Scan) else as_scan(scan), settings)


def _off(found: Hypothesis, truth: np.ndarray) -> tuple[float, float]:
    metres, radians = difference(found.target_from_source, truth)
    return metres * 100, float(np.degrees(radians))


def test_defaults_are_those_of_table_1() -> None:
    assert SETTINGS.voxel_size == 0.05
    assert SETTINGS.max_correspondence_distance == 0.05
    assert (SETTINGS.normal_radius, SETTINGS.normal_max_neighbors) == (0.10, 30)
    assert (SETTINGS.min_fitness, SETTINGS.max_inlier_rmse) == (0.55, 0.05)


@pytest.mark.parametrize("number", [0, 1])
def test_register_finds_a_drifted_scan_to_a_centimetre(room: Room, number: int) -> None:
    truth = room.after[number].world_from_sensor
    drift = exponential(np.array([0.0, 0.0, np.radians(4), 0.2, -0.15, 0.02]))
    found = register(_ready(room.scan(number)), room.target, prior=truth @ drift, settings=SETTINGS)
    centimetres, degrees = _off(found, truth)
    assert centimetres < 1.5
    assert degrees < 0.3
    assert not found.from_global_search


def test_candidates_are_told_by_some_of_the_points_and_the_pose_by_all(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.pipeline.registration.refinement._ENOUGH", 1000)
    scan = prepare(room.scan(), SETTINGS)
    found = register(scan, room.target, prior=room.after[0].world_from_sensor, settings=SETTINGS)
    assert found.num_inliers > len(scan.surface.points) / 2


def test_register_finds_a_scan_with_no_start_at_all(room: Room) -> None:
    found = register(_ready(room.scan()), room.target, settings=SETTINGS)
    centimetres, degrees = _off(found, room.after[0].world_from_sensor)
    assert centimetres < 1.5
    assert degrees < 0.3
    assert found.from_global_search


def test_a_result_carries_the_numbers_of_the_registration_and_the_sensors_place_in_the_map(
    room: Room,
) -> None:
    truth, scan = room.after[0].world_from_sensor, _ready(room.scan())
    found = register(scan, room.target, prior=truth, settings=SETTINGS)
    result = registration_result(found, scan.origin)
    assert result.map_from_scan.tolist() == found.target_from_source.tolist()
    assert result.sensor_origin == pytest.approx(truth[:3, 3], abs=0.02)
    assert (result.fitness, result.inlier_rmse) == (found.fitness, found.inlier_rmse)
    assert (result.overlap, result.two_way_inlier_ratio) == (found.overlap, found.two_way_inlier_ratio)
    assert not result.from_global_search
    better = truth @ exponential(np.array([0, 0, 0, 1.0, 0, 0]))
    refined = registration_result(found, scan.origin, pose=better)
    assert refined.map_from_scan.tolist() == better.tolist()
    assert refined.sensor_origin == pytest.approx(better[:3, 3])
    assert registration_result(found, None).sensor_origin is None


def test_a_scan_of_another_place_is_rejected_with_its_numbers(room: Room) -> None:
    elsewhere = visit(random_room(11), 1, seed=5)[0]
    with pytest.raises(
        ScanRejected, match=r"scan foreign\.pcd: .*(\d\.\d% lie on each other|covers \d+\.\d% of it)"
    ) as error:
        register(_ready(as_scan(elsewhere.points, name="foreign.pcd")), room.target, settings=ONE_DRAW)
    assert error.value.fitness is not None
    assert 0 <= error.value.fitness < 0.9


def test_a_pose_far_from_a_given_prior_is_not_taken(room: Room) -> None:
    wrong = room.after[0].world_from_sensor @ exponential(np.array([0, 0, np.pi / 2, 2.5, 0.0, 0.0]))
    with pytest.raises(ScanRejected):
        register(_ready(room.scan()), room.target, prior=wrong, settings=ONE_DRAW)


def test_a_bare_plane_is_refused_before_it_can_slide() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-4, 4, (40_000, 2)), rng.normal(-0.4, 0.015, 40_000)])
    with pytest.raises(ScanRejected, match="leave a motion free"):
        _ready(plane.astype(np.float32))


def test_a_scan_that_shares_only_a_floor_with_the_map_is_refused(room: Room) -> None:
    points = room.target.points
    low, high = points.min(axis=0) + 0.6, points.max(axis=0) - 0.6
    inner = ((points > low) & (points < high))[:, :2].all(axis=1)
    floor = points[inner & (np.abs(points[:, 2]) < 0.04)]
    target = surface_of(Voxels.of(floor, size=0.05), SETTINGS)
    start = room.after[0].world_from_sensor
    lenient = {
        "min_overlap_near_prior": 0.05,
        "min_inlier_ratio": 0.5,
        "prior_distance": 99.0,
        "prior_angle": 3.2,
    }
    settings = SETTINGS.model_copy(update=lenient)
    with pytest.raises(ScanRejected, match="shares with the map leaves a motion free"):
        register(_ready(room.scan()), target, prior=start, settings=settings)


def test_too_few_points_are_refused_with_their_number() -> None:
    few = as_scan(np.random.default_rng(0).uniform(0, 5, (60, 3)).astype(np.float32), name="few.ply")
    with pytest.raises(ScanRejected, match=r"few\.ply: 60 voxels .* 500 are needed"):
        _ready(few)


@pytest.fixture(scope="module")
def office() -> tuple[SimulatedScan, ...]:
    """Rooms that share walls 12 cm thick, with doors between them."""
    return visit(small_office(1), 14, seed=1, prior_error=(0.1, 2.0))


def _map_of(scans: tuple[SimulatedScan, ...]) -> Surface:
    parts = (Voxels.of(each.world_points, size=0.05, origin=each.world_from_sensor[:3, 3]) for each in scans)
    return surface_of(functools.reduce(Voxels.merged, parts), SETTINGS)


def test_a_wall_seen_from_its_other_side_does_not_pull_the_scan_over(
    office: tuple[SimulatedScan, ...],
) -> None:
    """The map knows the room behind the wall and, through the door, a little more."""
    scan = office[4]
    found = register(_ready(scan.points), _map_of(office[:4]), prior=scan.prior, settings=SETTINGS)
    assert _off(found, scan.world_from_sensor)[0] < 2.0


def test_a_good_prior_is_not_dragged_away_where_the_map_shares_little_with_the_scan(
    office: tuple[SimulatedScan, ...],
) -> None:
    """Seen through a door: with the wide gates alone this scan finds no place."""
    scan, target = office[8], _map_of((*office[:8], *office[10:]))
    settings = SETTINGS.model_copy(update={"search_resolutions": ()})
    found = register(_ready(scan.points), target, prior=scan.prior, settings=settings)
    assert _off(found, scan.world_from_sensor)[0] < 2.0


@pytest.mark.parametrize(("size", "expected"), [(1, 1e-4), (2, 0.001)])
def test_least_eigenvalue_of_one_and_two_planes_is_next_to_nothing(size: int, expected: float) -> None:
    rng = np.random.default_rng(0)
    planes = [np.column_stack([rng.uniform(-4, 4, (30_000, 2)), rng.normal(0, 0.015, 30_000)])]
    if size == 2:
        planes.append(planes[0][:, [0, 2, 1]] + (0, 4, 2))
    assert least_eigenvalue(np.concatenate(planes)) <= expected


def test_least_eigenvalue_of_a_furnished_room_is_firm(room: Room) -> None:
    assert least_eigenvalue(room.after[0].points) > 10 * SETTINGS.min_eigenvalue


REAL_PAIRS = {
    "room_scan": ("room_scan2.pcd", "room_scan1.pcd", "T_scan2_to_scan1.txt"),
    "ipad_rooms 808": ("pix4d_user_808_user.ply", "pix4d_database_808_db.ply", "T_user_to_db_808.txt"),
    "ipad_rooms 560": ("pix4d_user_560_user.ply", "pix4d_database_560_db.ply", "T_user_to_db_560.txt"),
    "corridor_pair": ("cloud_1.ply", "cloud_0.ply", "T_cloud1_to_cloud0.txt"),
}


@pytest.mark.parametrize("pair", REAL_PAIRS)
def test_real_pairs_land_within_3_cm_and_half_a_degree_with_no_start(shared_data: Path, pair: str) -> None:
    folder = shared_data / pair.split(maxsplit=1)[0]
    current, reference, transform = (folder / name for name in REAL_PAIRS[pair])
    base = read_scan(reference)
    voxels = Voxels.of(base.points, size=SETTINGS.voxel_size)
    found = register(_ready(read_scan(current)), surface_of(voxels, SETTINGS), settings=SETTINGS)
    centimetres, degrees = _off(found, np.loadtxt(transform))
    assert centimetres < 3.0
    assert degrees < 0.5


def test_a_scan_that_was_moved_by_kilometres_while_its_viewpoint_was_not_is_registered(
    shared_data: Path,
) -> None:
    """Its normals once turned to a sensor 3.6 km away, and half of its walls then faced the wrong way."""
    scan, shift = read_scan(shared_data / "room_scan" / "room_scan2.pcd"), np.array([3000.0, 2000.0, 0.0])
    base = read_scan(shared_data / "room_scan" / "room_scan1.pcd")
    target = surface_of(Voxels.of(base.points, size=SETTINGS.voxel_size, origin=np.zeros(3)), SETTINGS)
    found = register(_ready((scan.points + shift).astype(np.float32)), target, settings=SETTINGS)
    given = np.loadtxt(shared_data / "room_scan" / "T_scan2_to_scan1.txt")
    there = transformed(scan.points + shift, found.target_from_source)
    assert np.abs(there - transformed(scan.points, given)).max() < 0.03


@pytest.mark.parametrize(
    ("current", "reference"),
    [
        ("ipad_rooms/pix4d_user_560_user.ply", "room_scan/room_scan1.pcd"),
        ("ipad_rooms/pix4d_user_808_user.ply", "ipad_rooms/pix4d_database_560_db.ply"),
        ("corridor_pair/cloud_1.ply", "room_scan/room_scan1.pcd"),
    ],
)
def test_real_scans_of_different_places_are_rejected(shared_data: Path, current: str, reference: str) -> None:
    voxels = Voxels.of(read_scan(shared_data / reference).points, size=SETTINGS.voxel_size)
    with pytest.raises(ScanRejected):
        register(_ready(read_scan(shared_data / current)), surface_of(voxels, SETTINGS), settings=ONE_DRAW)


def test_asking_for_more_inliers_is_heeded_with_and_without_a_prior(room: Room) -> None:
    strict = SETTINGS.model_copy(update={"min_inlier_ratio": 1.0, "search_resolutions": ()})
    for start in (None, room.after[0].world_from_sensor):
        with pytest.raises(ScanRejected, match="at least 1"):
            register(_ready(room.scan()), room.target, prior=start, settings=strict)


def test_a_room_without_furniture_is_not_believed_half_turned_when_a_better_turn_is_there() -> None:
    """A box of 6 x 4 m with a closet in one corner: half a turn puts walls on walls."""
    rng = np.random.default_rng(4)
    target = surface_of(Voxels.of(_box_room(rng), size=0.05, origin=np.zeros(3)), SETTINGS)
    half = exponential(np.array([0.0, 0.0, np.pi, 0.0, 0.0, 0.0]))
    turned = _box_room(rng) @ half[:3, :3].T
    found = register(_ready(turned.astype(np.float32)), target, settings=SETTINGS)
    centimetres, degrees = _off(found, half)
    assert centimetres < 3
    assert degrees < 0.5


def _box_room(rng: np.random.Generator) -> np.ndarray:
    """(N, 3) noisy points on floor, ceiling, walls and a closet, seen from the middle."""
    size, parts = np.array([6.0, 4.0, 2.5]), []
    for axis in range(3):
        for side in (-0.5, 0.5):
            flat = rng.uniform(-0.5, 0.5, (9000, 3))
            flat[:, axis] = side
            parts.append(flat * size)
    closet = rng.uniform(0, 1, (4000, 3)) * (0.6, 1.0, 1.8) + (2.35, 0.95, -1.25)
    closet[:2000, 0] = 2.35
    closet[2000:, 1] = 0.95
    cloud = np.concatenate([*parts, closet])
    return cloud + rng.normal(0, 0.01, cloud.shape)
