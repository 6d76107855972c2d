from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room, as_scan
from tests.support.walks import corridor_points, joint_settings, prepared_folder, spread
from worker.cloud.poses import difference, exponential, inverse
from worker.cloud.types import Matrix4, Points
from worker.pipeline.mapping.multiview_refinement import FLOOR, Refined, refine_jointly, uncertainties
from worker.pipeline.mapping.pose_graph_optimization import Factor, covariances
from worker.pipeline.mapping.tasks import Folder, LinearizedPair, Workspace, downsample
from worker.pipeline.registration.icp import NormalEquations, normal_equations
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.settings import RegistrationSettings
from worker.processes import Processes


@pytest.fixture(scope="module")
def truth(room: Room) -> dict[int, Matrix4]:
    """In the frame of the first scan."""
    first = inverse(room.before[0].world_from_sensor)
    return {number: first @ scan.world_from_sensor for number, scan in enumerate(room.before)}


@pytest.fixture(scope="module")
def scans(room: Room, tmp_path_factory: pytest.TempPathFactory) -> tuple[Folder, dict[int, Points]]:
    return prepared_folder(tmp_path_factory.mktemp("prepared"), dict(enumerate(room.before)))


def refined(
    poses: dict[int, Matrix4],
    scans: tuple[Folder, dict[int, Points]],
    *,
    fixed: int = 0,
    rounds: int = 3,
    ties: Sequence[tuple[int, int]] = (),
    told: list[float] | None = None,
) -> Refined:
    folder, points = scans
    return refine_jointly(
        poses,
        {number: points[number] for number in poses},
        Workspace(
            folder=folder, processes=Processes(None), settings=joint_settings(refinement_rounds=rounds)
        ),
        fixed=fixed,
        ties=ties,
        progress=lambda share: None if told is None else told.append(share),
    )


def perturbed(poses: dict[int, Matrix4], *, fixed: int = 0) -> dict[int, Matrix4]:
    """By about 2 cm and 0.3 degrees each."""
    rng = np.random.default_rng(5)
    twists = {number: np.r_[rng.normal(0, 0.005, 3), rng.normal(0, 0.02, 3)] for number in poses}
    return {n: pose if n == fixed else pose @ exponential(twists[n]) for n, pose in poses.items()}


def test_four_scans_that_are_two_centimetres_off_come_back_to_some_millimetres(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    start = perturbed(truth)
    assert spread(start, truth) > 0.03
    told: list[float] = []
    found = refined(start, scans, told=told)
    assert spread(found.poses, truth) < 0.012  # each scan has a range bias of half a centimetre
    assert found.poses[0].tolist() == truth[0].tolist()
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert max(found.free_space_violation.values()) < 0.002


def test_any_scan_may_be_the_fixed_one(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    start = perturbed(truth, fixed=2)
    found = refined(start, scans, fixed=2)
    assert found.poses[2].tolist() == start[2].tolist()
    assert spread(found.poses, truth) < 0.012
    assert set(found.uncertainties) == {0, 1, 2, 3}
    assert found.uncertainties[2] == FLOOR


def test_uncertainties_are_what_the_errors_are(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    """None is surer than the floor, and none is off by more than four sigma of what it says."""
    found = refined(truth, scans)
    for number, sure in found.uncertainties.items():
        assert sure.translation >= FLOOR.translation
        assert sure.rotation >= FLOOR.rotation
        assert sure.translation < 0.02
        metres, radians = difference(found.poses[number], truth[number])
        assert metres < 4 * sure.translation
        assert radians < 4 * sure.rotation


def test_without_rounds_nothing_moves_and_the_uncertainty_is_told(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    start = perturbed(truth)
    found = refined(start, scans, rounds=0)
    assert all(found.poses[number].tolist() == start[number].tolist() for number in start)
    assert set(found.uncertainties) == set(truth)


def test_a_scan_alone_stays_with_the_least_uncertainty_there_is(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    found = refined({1: truth[1]}, scans, fixed=1)
    assert found.poses[1].tolist() == truth[1].tolist()
    assert found.uncertainties == {1: FLOOR}
    assert found.free_space_violation == {1: 0.0}


def test_a_scan_beside_nobody_stays_is_unsure_and_spoils_no_other(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    far = shifted(80.0) @ truth[3]
    found = refined(perturbed(truth) | {3: far}, scans)
    assert found.poses[3].tolist() == far.tolist()
    assert found.uncertainties[3].translation > 0.1
    three = {number: truth[number] for number in range(3)}
    assert spread({number: found.poses[number] for number in three}, three) < 0.012
    assert max(found.uncertainties[number].translation for number in three) < 0.02


def test_pairs_that_are_named_are_refined_though_their_boxes_share_nothing(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    folder, points = scans
    apart = {0: points[0], 1: points[1] + np.array([60.0, 0, 0])}  # extents only: the scans stay as they are
    start = perturbed({number: truth[number] for number in (0, 1)})
    alone = refined(start, (folder, apart))
    assert alone.poses[1].tolist() == start[1].tolist()
    tied = refined(start, (folder, apart), ties=[(1, 0), (7, 1)])
    assert spread(tied.poses, {number: truth[number] for number in (0, 1)}) < 0.012


def test_a_scan_a_metre_and_a_half_off_is_seen_through_and_those_beside_it_less(
    truth: dict[int, Matrix4], scans: tuple[Folder, dict[int, Points]]
) -> None:
    found = refined(truth | {3: shifted(1.5) @ truth[3]}, scans, rounds=0)
    assert max(found.free_space_violation, key=lambda number: found.free_space_violation[number]) == 3
    assert found.free_space_violation[3] > 0.03


def corridor(*, ends: bool, seed: int) -> PreparedScan:
    return prepare(as_scan(corridor_points(ends=ends, seed=seed)), RegistrationSettings(min_eigenvalue=0.0))


def corridor_equations(
    target_from_source: Matrix4 | None = None,
    *,
    ends: bool = True,
    within: float = 0.05,
    frame_from_target: Matrix4 | None = None,
) -> NormalEquations:
    """Of two scans of one corridor, at identity if no pose is given."""
    a, b = (corridor(ends=ends, seed=seed) for seed in (0, 1))
    pose = np.eye(4) if target_from_source is None else target_from_source
    return normal_equations(
        b.surface,
        a.surface,
        pose,
        max_correspondence_distance=within,
        frame_from_target=frame_from_target,
    )


def pair_of(equations: NormalEquations) -> LinearizedPair:
    return LinearizedPair(target=0, source=1, equations=equations)


def test_a_bare_corridor_is_unsure_along_its_axis_and_sure_across_it() -> None:
    bare = corridor_equations(ends=False)
    factor = Factor(target=0, source=1, information=bare.information, gradient=bare.gradient)
    block = covariances([0, 1], [factor], fixed=0, variance=1e-4)[1]
    along, across, up = np.sqrt(np.diag(block)[3:])
    assert along > 5 * across
    assert along > 5 * up


def test_end_walls_make_a_corridor_sure() -> None:
    poses = {0: np.eye(4), 1: np.eye(4)}
    bare, ended = (
        uncertainties(poses, [pair_of(corridor_equations(ends=ends))], fixed=0)[1].translation
        for ends in (False, True)
    )
    assert ended < 0.01
    assert bare > 2 * ended


def test_a_scan_far_from_the_maps_origin_is_as_sure_as_one_near_it() -> None:
    """Twists act about the map's origin: 360 m from it a turn moves a place far, and the shift takes that back."""
    here = uncertainties({0: np.eye(4), 1: np.eye(4)}, [pair_of(corridor_equations())], fixed=0)[1]
    away = shifted(300.0, -200.0, yaw=0.4)
    far_pair = pair_of(corridor_equations(frame_from_target=away))
    there = uncertainties({0: away, 1: away}, [far_pair], fixed=0)[1]
    assert there.translation == pytest.approx(here.translation, rel=0.02)
    assert there.rotation == pytest.approx(here.rotation, rel=0.02)


def test_gradient_and_information_are_those_of_the_squared_distances() -> None:
    """A source that stands 1 cm off the walls of its target: the step of the quadratic lays it on them."""
    by = shifted(0.01, -0.012, 0.008, yaw=0.002)
    first = corridor_equations(by, within=0.1)
    step = -np.linalg.solve(first.information, first.gradient).astype(np.float64)
    metres, radians = difference(exponential(step) @ by, np.eye(4))
    assert metres < 0.004
    assert radians < 0.0005
    less = exponential(0.5 * step)
    twist = np.r_[0.5 * step]
    promised = twist @ first.information @ twist + 2 * first.gradient @ twist
    shifted_less = corridor_equations(less @ by, within=0.1)
    before, after = (item.num_inliers * item.square_residual for item in (first, shifted_less))
    assert after - before == pytest.approx(promised, rel=0.1)
    assert promised < 0


def test_thinned_points_of_a_scan_are_one_in_half_a_metre() -> None:
    points = downsample(corridor(ends=True, seed=0).surface.points)
    assert 100 < len(points) < 1500


def test_a_round_undoes_a_turn_as_well_far_from_the_maps_origin(tmp_path: Path) -> None:
    """A map in the coordinates of a site: half a degree is found there as it is at the origin."""
    off = exponential(np.array([0, 0, np.radians(0.5), 0, 0, 0]))
    folder = Folder(root=tmp_path)
    parts = {number: corridor(ends=True, seed=number) for number in (0, 1)}
    for number, part in parts.items():
        part.save(folder.path(number))
    points = {number: downsample(part.surface.points) for number, part in parts.items()}
    left = []
    for origin in (np.eye(4), shifted(300.0, -200.0, yaw=0.4)):
        found = refined({0: origin, 1: origin @ off}, (folder, points), rounds=1)
        left.append(difference(found.poses[0], found.poses[1])[1])
    assert left[0] < np.radians(0.1)
    assert left[1] == pytest.approx(left[0], abs=1e-5)
