from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.support.graphs import shifted
from tests.support.rooms import Room
from tests.worker.pipeline.placement.conftest import prepared
from worker.pipeline.placement.belief import confidence, log_odds, odds_of, shares
from worker.pipeline.placement.contradictions import (
    BUILDING,
    INTO_MAP,
    INTO_SCAN,
    THINGS,
    Contradictions,
    Place,
    building_of,
    contradictions,
    held_both_ways,
)
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.simulation.sensor import SimulatedScan


def told_of(scan: PreparedScan, place: Place, pose: np.ndarray) -> Contradictions:
    return contradictions(scan, place, pose)


def test_nothing_contradicts_a_right_pose(room: Room, place: Place, right: PreparedScan) -> None:
    told = told_of(right, place, room.after[0].world_from_sensor)
    assert (told.judged[:, BUILDING] > 1000).all()
    assert (told.through[:, BUILDING] / told.judged[:, BUILDING] < 0.005).all()
    assert (told.through[:, THINGS] / told.judged[:, THINGS] < 0.05).all()
    assert told.things[:, 0].sum() > 5 * told.things[:, 1].sum()


def test_a_pose_half_a_metre_off_is_contradicted_by_walls(
    room: Room, place: Place, right: PreparedScan
) -> None:
    told = told_of(right, place, shifted(0.5, 0.0) @ room.after[0].world_from_sensor)
    assert (told.through[:, BUILDING] / told.judged[:, BUILDING]).max() > 0.05
    odds = log_odds(told)
    assert odds is not None
    assert confidence(odds) < 0.05


def test_the_same_shell_with_other_furniture_is_contradicted_by_things_and_not_by_walls(
    place: Place, anew: SimulatedScan
) -> None:
    told = told_of(prepared(anew), place, anew.world_from_sensor)
    through = told.through.sum(axis=0) / told.judged.sum(axis=0)
    assert through[BUILDING] < 0.02
    assert through[THINGS] > 0.3
    assert told.things[:, 1].sum() > told.things[:, 0].sum() / 2
    odds = log_odds(told)
    assert odds is not None
    assert confidence(odds) < 0.5


def test_both_directions_are_held_at_places_of_the_map_frame(
    room: Room, place: Place, right: PreparedScan
) -> None:
    both = held_both_ways(right, place, room.after[0].world_from_sensor)
    low, high = room.target.points.min(axis=0) - 0.1, room.target.points.max(axis=0) + 0.1
    for held in (both[INTO_MAP], both[INTO_SCAN]):
        assert ((held.points > low) & (held.points < high)).all()
        assert not (held.through & ~held.judged).any()
        assert not (held.off & ~held.near).any()


def test_without_what_the_map_saw_the_scans_own_rays_speak_for_both(room: Room, right: PreparedScan) -> None:
    blind = Place(surface=room.target, sights=None)
    told = told_of(right, blind, room.after[0].world_from_sensor)
    assert told.judged[INTO_MAP].sum() == 0
    assert told.judged[INTO_SCAN].sum() > 1000
    odds = log_odds(told)
    assert odds is not None
    assert confidence(odds) > 0.9
    off = log_odds(told_of(right, blind, shifted(0.5, 0.0) @ room.after[0].world_from_sensor))
    assert off is not None
    assert confidence(off) < 0.05


def test_without_any_rays_nothing_is_said(room: Room, right: PreparedScan) -> None:
    unseen = replace(right, sights=None)
    told = told_of(unseen, Place(surface=room.target, sights=None), room.after[0].world_from_sensor)
    assert told.near.min() > 0
    assert log_odds(told) is None


def test_walls_floor_and_lamps_are_the_building_and_a_table_is_a_thing() -> None:
    across, up = (axis.ravel() for axis in np.meshgrid(np.arange(0, 4, 0.05), np.arange(0, 2.5, 0.05)))
    wall = np.column_stack([across, np.zeros_like(across), up])
    top = np.array([[x, y, 0.7] for x in np.arange(1, 2, 0.05) for y in np.arange(1, 2, 0.05)])
    front = np.array([[x, 1.0, z] for x in np.arange(1, 2, 0.05) for z in np.arange(0.2, 0.7, 0.05)])
    floor = np.array([[x, y, 0.02] for x in np.arange(0, 4, 0.1) for y in np.arange(0.1, 3, 0.1)])
    lamp = np.array([[x, 2.0, 2.2] for x in np.arange(1, 2, 0.05)])
    points = np.concatenate([wall, floor, lamp, top, front])
    normals = np.concatenate(
        [
            np.tile([0.0, 1.0, 0.0], (len(wall), 1)),
            np.tile([0.0, 0.0, 1.0], (len(floor), 1)),
            np.tile([0.0, 0.0, -1.0], (len(lamp), 1)),
            np.tile([0.0, 0.0, 1.0], (len(top), 1)),
            np.tile([0.0, -1.0, 0.0], (len(front), 1)),
        ]
    )
    building = building_of(points, normals)
    things = len(top) + len(front)
    assert building[: len(wall)].mean() > 0.95
    assert building[len(wall) : -things].all()
    assert not building[-things:].any()


def test_shares_grow_with_what_speaks_against_a_pose_and_few_points_prove_little() -> None:
    def told(through: float, judged: float) -> Contradictions:
        part = np.array([[judged, 0.0], [judged, 0.0]])
        nothing = np.zeros((2, 2))
        return Contradictions(judged=part, through=part * through, near=nothing, off=nothing, things=nothing)

    assert shares(told(0.2, 3000))[1] > shares(told(0.1, 3000))[1] > 0
    assert shares(told(0.2, 3000))[1] > shares(told(0.2, 100))[1]
    assert log_odds(told(0.0, 100)) is None
    assert log_odds(told(0.0, 3000)) > log_odds(told(0.1, 3000))  # type: ignore[operator]


def test_odds_and_probabilities_are_each_others_inverse() -> None:
    for probability in (0.1, 0.5, 0.99):
        assert np.isclose(confidence(odds_of(probability)), probability)
