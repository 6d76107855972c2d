"""The scans of each kind of trial, and that their truth is true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.placement import ROOM, SETTINGS
from worker.benchmarks.placement.plan import SitePlan, Trial
from worker.benchmarks.placement.sites import load_site, map_stops
from worker.benchmarks.placement.surveys import (
    MOVED,
    SIZE_OFF,
    covered,
    other_scene,
    simulate,
    trial_scans,
)
from worker.cloud.poses import difference, inverse, transformed


def scans_of(site, kind, **given):
    return trial_scans(Trial(site=ROOM, number=1, kind=kind, **given), site, SETTINGS)


def off_the_map(scan, site):
    return 1 - covered(scan.points, site, scan.true)


@pytest.mark.parametrize("prior", [False, True])
def test_right_scans_lie_on_the_map_at_their_true_poses(site, prior):
    scans = scans_of(site, "right", scans=2, prior=prior)
    assert len(scans) == 2
    for scan in scans:
        assert off_the_map(scan, site) < 0.1
        if prior:
            metres, radians = difference(scan.true, scan.prior)
            assert 0 < metres <= 0.26 and np.degrees(radians) <= 4.01
        else:
            assert scan.prior is None


def test_changed_furniture_shows_in_a_right_scan(site):
    (same,), (edited,) = scans_of(site, "right"), scans_of(site, "right", amount=0.4)
    assert off_the_map(edited, site) > off_the_map(same, site)


@pytest.mark.parametrize("kind", ["other", "same-size", "twin"])
def test_impostors_have_no_place_and_priors_at_the_maps_stops(site, kind):
    first, second = scans_of(site, kind, scans=2, prior=True)
    assert first.true is None and second.true is None
    stops = [(site.map_from_world @ pose)[:2, 3] for pose in site.stops]
    assert min(np.linalg.norm(first.prior[:2, 3] - stop) for stop in stops) <= 0.26
    assert not np.array_equal(first.points, second.points)


def test_a_twin_has_the_rooms_walls_and_a_room_of_the_same_size_nearly_its_measures():
    room = ROOM.scene().rooms[0]
    twin = other_scene(Trial(site=ROOM, number=1, kind="twin"))
    assert twin.rooms[0] == room
    same = other_scene(Trial(site=ROOM, number=1, kind="same-size")).rooms[0]
    off = np.abs(np.subtract([*same.high, same.height], [*room.high, room.height]))
    assert 0 < off.max() <= SIZE_OFF


def test_rooms_and_corridors_of_one_hotel_are_others_of_the_same_hotel():
    for kind in ("hotel-room", "hotel-corridor"):
        site = SitePlan(kind=kind, seed=3)
        names = {other_scene(Trial(site=site, number=number, kind="hotel")).name for number in range(3)}
        assert len(names) == 3 and all(name.startswith(f"{kind}-3-") for name in names)


def test_wrong_priors_are_off_by_what_they_say(site):
    (scan,) = scans_of(site, "prior-off", amount=2.0, prior=True)
    assert difference(scan.true, scan.prior) == pytest.approx((2.0, 0.0), abs=1e-6)
    (scan,) = scans_of(site, "prior-turned", amount=90.0, prior=True)
    assert difference(scan.true, scan.prior) == pytest.approx((0.0, np.pi / 2), abs=1e-6)
    (scan,) = scans_of(site, "prior-turned", prior=True)
    assert np.degrees(difference(scan.true, scan.prior)[1]) >= 19.9


def test_spoilt_scans_are_the_right_one_mirrored_scaled_and_turned(site):
    (right,) = scans_of(site, "tilted", amount=0.0)
    (mirrored,) = scans_of(site, "mirrored")
    assert (
        np.array_equal(mirrored.points, right.points * np.array([-1, 1, 1], np.float32))
        and mirrored.true is None
    )
    (scaled,) = scans_of(site, "scaled", amount=1.02)
    assert np.allclose(scaled.points, 1.02 * right.points) and scaled.true is None
    (slightly,) = scans_of(site, "scaled", amount=0.99)
    assert np.array_equal(slightly.true, right.true)
    (tilted,) = scans_of(site, "tilted", amount=180.0)
    assert np.allclose(tilted.points, right.points * [1, -1, -1], atol=1e-5)
    assert np.allclose(
        transformed(tilted.points, tilted.true), transformed(right.points, right.true), atol=1e-4
    )


def test_partial_scans_keep_a_wedge_or_a_twentieth(site):
    (right,) = scans_of(site, "tilted", amount=0.0)
    (wedge,) = scans_of(site, "wedge", amount=120.0)
    azimuths = np.degrees(np.unwrap(np.sort(np.arctan2(wedge.points[:, 1], wedge.points[:, 0]))))
    assert 0.1 * len(right.points) < len(wedge.points) < 0.9 * len(right.points)
    assert np.ptp(azimuths) <= 120.1 or np.diff(azimuths).max() >= 239.0
    (thin,) = scans_of(site, "thin", amount=0.05)
    assert len(thin.points) == pytest.approx(0.05 * len(right.points), rel=0.1)


def test_the_points_of_a_moving_sensor_are_off_at_either_end_and_right_in_the_middle(site):
    (right,) = scans_of(site, "tilted", amount=0.0)
    (moving,) = scans_of(site, "moving")
    off = np.linalg.norm(moving.points - right.points, axis=1)
    middle = len(off) // 2
    assert off[middle] < 0.01
    near = np.linalg.norm(right.points, axis=1) < 1.0
    assert np.median(off[:500][near[:500]]) == pytest.approx(MOVED / 2, abs=0.1)


@pytest.mark.parametrize(("kind", "scans"), [("mixed-1+1", 2), ("mixed-3+1", 4)])
def test_a_mixed_survey_has_one_scan_of_another_place(site, kind, scans):
    mixed = scans_of(site, kind, scans=scans, prior=True)
    assert len(mixed) == scans
    assert sum(scan.true is None for scan in mixed) == 1
    assert all(off_the_map(scan, site) < 0.1 for scan in mixed if scan.true is not None)


def test_the_same_trial_gives_the_same_files(site, tmp_path: Path):
    trial = Trial(site=ROOM, number=1, kind="twin", scans=2)
    first = simulate(trial, site, SETTINGS, tmp_path / "first")
    again = simulate(trial, site, SETTINGS, tmp_path / "again")
    for one, other in zip(first.files, again.files, strict=True):
        assert one.path.read_bytes() == other.path.read_bytes()
    assert first.true == (None, None)


def test_a_map_of_half_a_place_is_of_the_stops_at_one_end():
    whole, half = SitePlan(kind="corridor", seed=3), SitePlan(kind="corridor", seed=3, half=True)
    scene = whole.scene()
    settings = SETTINGS.with_values(stops={"corridor": 12})
    chosen = map_stops(half, scene, settings)
    assert 2 <= len(chosen) < 12
    assert max(pose[0, 3] for pose in chosen) < 10.2
    assert {pose.tobytes() for pose in chosen} < {
        pose.tobytes() for pose in map_stops(whole, scene, settings)
    }


def test_the_frame_of_a_map_is_turned_against_the_building(site):
    assert difference(site.map_from_world, np.eye(4))[1] > np.radians(5)
    inside = transformed(site.reference.points, inverse(site.map_from_world))
    assert np.median(ROOM.scene().caster.distances(inside)) < 0.02


def test_a_scan_of_low_overlap_is_covered_by_a_third_to_a_half(folder):
    settings = SETTINGS.with_values(stops={"corridor": 12})
    half = SitePlan(kind="corridor", seed=2_700_001, half=True)
    site = load_site(half, settings, folder)
    (scan,) = trial_scans(Trial(site=half, number=1, kind="low-overlap"), site, settings)
    assert 0.3 <= 1 - off_the_map(scan, site) <= 0.52
