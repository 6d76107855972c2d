from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from tests.support.rooms import Room, as_scan
from worker.cloud.formats.scan import Scan
from worker.cloud.poses import transformed
from worker.cloud.sight import Sights
from worker.cloud.types import Matrix4, Points
from worker.errors import Cancelled
from worker.pipeline.placement.explanations import Refused, diagnose
from worker.pipeline.placement.variants import UP_AXES, mirrored, scaled, turned
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.refinement import Refinement
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

SETTINGS = RegistrationSettings()
Believed = Callable[[PreparedScan, Hypothesis], bool]


@pytest.fixture(scope="module")
def believed(room: Room) -> Believed:
    """Few points stand where the map's scans saw through."""
    sights = Sights.of((scan.world_points, scan.world_from_sensor[:3, 3]) for scan in room.before)
    assert sights is not None

    def few_contradictions(prepared: PreparedScan, hypothesis: Hypothesis) -> bool:
        there = transformed(prepared.surface.points, hypothesis.target_from_source)
        return bool((sights.verdicts(there).surely > 0).mean() < 0.03)

    return few_contradictions


def _refused(room: Room, believed: Believed, scan: Scan, start: Matrix4, *, max_searches: int = 6) -> Refused:
    """A scan that was refused, with the one hypothesis that ICP reaches from a start."""
    prepared: PreparedScan | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    with suppress(ScanRejected):
        prepared = prepare(scan, SETTINGS)
        refinement = Refinement(source=prepared.surface, target=room.target, prior=None, settings=SETTINGS)
        hypotheses = (refinement.from_start(start),)
    return Refused(
        scan=scan,
        prepared=prepared,
        hypotheses=hypotheses,
        target=room.target,
        settings=SETTINGS,
        prepare=functools.partial(prepare, settings=SETTINGS),
        believed=believed,
        max_searches=max_searches,
    )


def _moving(points: Points, *, metres: float) -> Points:
    """Return what a sensor that goes on along its x while it scans takes for the points (N, 3)."""
    gone = np.linspace(-metres / 2, metres / 2, len(points))
    return (points - gone[:, None] * (1, 0, 0)).astype(np.float32)


@pytest.mark.parametrize("factor", [0.95, 1.02])
def test_a_scan_that_is_a_few_percent_off_is_told_its_scale_where_it_lies(
    room: Room, believed: Believed, factor: float
) -> None:
    scan, truth = room.scan(), room.after[0].world_from_sensor
    diagnosis = diagnose(_refused(room, believed, scaled(scan, factor), truth, max_searches=0))
    assert diagnosis is not None
    assert diagnosis.reason == "wrong_scale"
    assert diagnosis.numbers["scale"] == pytest.approx(1 / factor, abs=0.005)
    assert diagnosis.numbers["sigma"] < 0.003
    assert diagnosis.detail.startswith("scan now.pcd: it fits the map after its lengths are multiplied by")


@pytest.mark.parametrize(("unit", "factor"), [("feet", 0.3048), (None, 1.25)])
def test_a_scan_in_another_unit_is_told_so_by_the_height_of_the_room(
    room: Room, believed: Believed, unit: str | None, factor: float
) -> None:
    case = _refused(room, believed, scaled(room.scan(), 1 / factor), np.eye(4), max_searches=2)
    diagnosis = diagnose(case)
    assert diagnosis is not None
    assert diagnosis.reason == "wrong_scale"
    assert diagnosis.numbers["scale"] == pytest.approx(factor, rel=0.005)
    assert ("as if it were in" in diagnosis.detail) == (unit is not None)
    assert unit is None or unit in diagnosis.detail


def test_a_mirrored_scan_is_told_so(room: Room, believed: Believed) -> None:
    diagnosis = diagnose(_refused(room, believed, mirrored(room.scan()), np.eye(4), max_searches=1))
    assert diagnosis is not None
    assert diagnosis.reason == "mirrored"


def test_a_scan_that_hung_upside_down_is_told_so(room: Room, believed: Believed) -> None:
    scan = turned(room.scan(), UP_AXES[-3].T)
    diagnosis = diagnose(_refused(room, believed, scan, np.eye(4), max_searches=4))
    assert diagnosis is not None
    assert diagnosis.reason == "other_up_axis"
    assert diagnosis.numbers == {"up": -3}
    assert "its -z axis points up" in diagnosis.detail


@pytest.mark.parametrize("metres", [0.2, 0.4])
def test_a_sensor_that_moved_is_told_by_how_much(room: Room, believed: Believed, metres: float) -> None:
    """From the middle of the first fifth of the time to the middle of the last: four fifths of the way."""
    scan = as_scan(_moving(room.after[0].points, metres=metres), name="now.pcd")
    truth = room.after[0].world_from_sensor
    diagnosis = diagnose(_refused(room, believed, scan, truth, max_searches=0))
    assert diagnosis is not None
    assert diagnosis.reason == "moved_while_scanning"
    assert diagnosis.numbers["metres"] == pytest.approx(0.8 * metres, abs=0.03)
    assert diagnosis.numbers["degrees"] < 0.5


def test_noise_is_damaged(room: Room, believed: Believed) -> None:
    noise = np.random.default_rng(0).uniform(-3, 3, (40_000, 3)).astype(np.float32)
    diagnosis = diagnose(_refused(room, believed, as_scan(noise), np.eye(4)))
    assert diagnosis is not None
    assert diagnosis.reason == "damaged"
    assert diagnosis.numbers["scatter"] > 0.1


def test_a_scan_of_which_the_map_has_a_part_overlaps_too_little(room: Room, believed: Believed) -> None:
    """The map holds a corner of the room, at a third of the scan."""
    corner = room.target.points[:, 0] < np.quantile(room.target.points[:, 0], 0.25)
    target = Surface.of(*(getattr(room.target, name)[corner] for name in ("points", "normals", "oriented")))
    small = Room(before=room.before, after=room.after, target=target)
    truth = room.after[0].world_from_sensor
    diagnosis = diagnose(_refused(small, believed, room.scan(), truth, max_searches=0))
    assert diagnosis is not None
    assert diagnosis.reason == "too_little_overlap"
    assert 0.1 < diagnosis.numbers["overlap"] < 0.5


def test_another_place_is_explained_by_nothing(room: Room, believed: Believed) -> None:
    other = visit(random_room(103), 1, seed=5)[0]
    assert diagnose(_refused(room, believed, as_scan(other.points), np.eye(4), max_searches=2)) is None


def test_a_right_scan_is_neither_scaled_nor_moving_nor_damaged(room: Room, believed: Believed) -> None:
    truth = room.after[0].world_from_sensor
    assert diagnose(_refused(room, believed, room.scan(), truth, max_searches=0)) is None


def test_nothing_is_explained_that_is_not_believed(room: Room) -> None:
    case = _refused(room, lambda _scan, _hypothesis: False, mirrored(room.scan()), np.eye(4), max_searches=1)
    assert diagnose(case) is None


def test_a_cancelled_job_stops_the_explaining(room: Room, believed: Believed) -> None:
    def cancel() -> None:
        raise Cancelled("dismissed")

    case = _refused(room, believed, mirrored(room.scan()), np.eye(4))
    cancelled = replace(case, tick=cancel)
    with pytest.raises(Cancelled):
        diagnose(cancelled)
