from __future__ import annotations

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room, as_scan
from tests.support.walks import QUICK
from tests.worker.pipeline.placement.conftest import prepared
from worker.cloud.poses import difference, exponential
from worker.cloud.types import Matrix4
from worker.pipeline.placement.contradictions import Place
from worker.pipeline.placement.placed_scan import PlacedScan
from worker.pipeline.placement.scan_placement import place_scan
from worker.pipeline.placement.settings import PlacementSettings
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.surface import Surface
from worker.simulation.sensor import SimulatedScan

PLACEMENT = PlacementSettings.model_validate({})


def placed(scan: PreparedScan, place: Place, prior: Matrix4 | None = None, **settings: object) -> PlacedScan:
    return place_scan(
        scan, place, prior=prior, registration=QUICK, placement=PLACEMENT.with_values(**settings)
    )


def turned(pose: Matrix4, degrees: float) -> Matrix4:
    """Turned about its own place."""
    result: Matrix4 = pose @ exponential(np.array([0, 0, np.radians(degrees), 0, 0, 0]))
    return result


def test_a_right_scan_is_believed_without_any_prior(room: Room, place: Place, right: PreparedScan) -> None:
    found = placed(right, place)
    metres, radians = difference(found.pose, room.after[0].world_from_sensor)
    assert metres < 0.03
    assert np.degrees(radians) < 0.5
    assert found.confidence is not None
    assert found.confidence > 0.95
    assert found.warnings == ()


@pytest.mark.parametrize(("metres", "degrees"), [(1.0, 0.0), (2.0, 10.0), (0.0, 90.0), (0.0, 180.0)])
def test_a_wrong_prior_is_overcome_and_told(
    room: Room, place: Place, right: PreparedScan, metres: float, degrees: float
) -> None:
    true = room.after[0].world_from_sensor
    prior = shifted(metres, 0.0) @ turned(true, degrees)
    found = placed(right, place, prior)
    assert difference(found.pose, true)[0] < 0.03
    told = [warning for warning in found.warnings if warning.reason == "wrong_prior"]
    if metres > 1.0 or degrees:  # a metre may still be refined from the prior itself
        assert len(told) == 1
        assert told[0].numbers["degrees"] == pytest.approx(degrees, abs=1)
        assert told[0].numbers["metres"] == pytest.approx(metres, abs=0.05)


def test_a_prior_that_is_farther_off_than_any_may_be_is_not_overcome(
    room: Room, place: Place, right: PreparedScan
) -> None:
    prior = shifted(9.0, 0.0) @ room.after[0].world_from_sensor
    with pytest.raises(ScanRejected) as refused:
        placed(right, place, prior)
    assert refused.value.diagnosis.reason == "wrong_prior"
    assert refused.value.diagnosis.numbers["metres"] == pytest.approx(9.0, abs=0.05)


@pytest.mark.parametrize("with_prior", [False, True])
def test_another_room_is_not_believed(place: Place, elsewhere: SimulatedScan, with_prior: bool) -> None:
    prior = elsewhere.world_from_sensor if with_prior else None
    with pytest.raises(ScanRejected) as refused:
        placed(prepared(elsewhere), place, prior)
    assert refused.value.diagnosis.reason in ("other_place", "no_fit", "wrong_prior")


def test_the_same_shell_furnished_anew_is_not_believed_even_where_the_prior_says_so(
    place: Place, anew: SimulatedScan
) -> None:
    try:
        found = placed(prepared(anew), place, anew.world_from_sensor)
    except ScanRejected as refused:
        assert refused.diagnosis.reason == "other_place"
        assert refused.diagnosis.numbers["things_seen_through"] > 0.3
    else:
        assert found.confidence is not None
        assert found.confidence < PLACEMENT.min_confidence


def test_a_room_without_anything_in_it_is_ambiguous_and_the_prior_breaks_the_tie() -> None:
    """A bare rectangle: half a turn fits as well."""
    surface, scans = _bare_room()
    place = Place(surface=surface, sights=scans.sights)
    with pytest.raises(ScanRejected) as refused:
        placed(scans, place)
    diagnosis = refused.value.diagnosis
    assert diagnosis.reason == "ambiguous"
    assert len(diagnosis.poses) == diagnosis.numbers["poses"] >= 2
    assert diagnosis.numbers["degrees"] == pytest.approx(180, abs=2)
    for degrees in (0.0, 180.0):
        found = placed(scans, place, turned(np.eye(4), degrees))
        assert np.degrees(difference(found.pose, turned(np.eye(4), degrees))[1]) < 1


@pytest.mark.parametrize(("scale", "told"), [(1.0, 0), (1.01, 1)])
def test_a_scale_that_is_off_by_a_percent_is_a_warning_or_a_refusal_by_setting(
    room: Room, place: Place, scale: float, told: int
) -> None:
    scan = room.after[1]
    stretched = prepare(as_scan((scan.points * scale).astype(np.float32)), QUICK, with_sights=True)
    found = placed(stretched, place, scan.world_from_sensor)
    assert [warning.reason for warning in found.warnings] == ["wrong_scale"] * told
    if told:
        assert found.warnings[0].numbers["scale"] == pytest.approx(1 / scale, abs=0.004)
        with pytest.raises(ScanRejected) as refused:
            placed(stretched, place, scan.world_from_sensor, scale="refuse")
        assert refused.value.diagnosis.reason == "wrong_scale"


def test_a_scan_whose_rays_are_not_known_is_placed_by_surfaces_alone(room: Room, place: Place) -> None:
    blind = prepare(as_scan(room.after[0].points), QUICK)
    found = placed(blind, Place(surface=place.surface, sights=None))
    assert difference(found.pose, room.after[0].world_from_sensor)[0] < 0.03
    assert found.confidence is None


def test_a_mirror_image_is_refused_also_where_no_rays_are_known(room: Room, place: Place) -> None:
    image = prepare(as_scan(room.after[0].points * np.array([-1, 1, 1], np.float32)), QUICK)
    with pytest.raises(ScanRejected) as refused:
        placed(image, Place(surface=place.surface, sights=None))
    assert refused.value.diagnosis.reason in ("mirrored", "no_fit")


def _bare_room() -> tuple[Surface, PreparedScan]:
    rng = np.random.default_rng(1)
    half = np.array([3.0, 2.0])
    floor = rng.uniform(-half, half, (24_000, 2))
    along, up = rng.uniform(-1, 1, (4, 12_000)), rng.uniform(-0.4, 2.2, (4, 12_000))
    sides = [
        np.column_stack([along[0] * half[0], np.full(12_000, -half[1]), up[0]]),
        np.column_stack([along[1] * half[0], np.full(12_000, half[1]), up[1]]),
        np.column_stack([np.full(12_000, -half[0]), along[2] * half[1], up[2]]),
        np.column_stack([np.full(12_000, half[0]), along[3] * half[1], up[3]]),
    ]
    flat = [np.column_stack([floor[::2], np.full(12_000, z)]) for z in (-0.4, 2.2)]
    points = np.concatenate([*sides, *flat]) + rng.normal(0, 0.01, (72_000, 3))
    scan = prepare(as_scan(points.astype(np.float32)), QUICK, with_sights=True)
    return scan.surface, scan
