"""A scan that shares little with the map may fit it in more than one place."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.rooms import as_scan
from worker.cloud.poses import difference
from worker.cloud.voxels import Voxels
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.scan_to_map import register
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, surface_of
from worker.simulation.scenes import small_office
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

SETTINGS = RegistrationSettings()
Office = tuple[Surface, tuple[SimulatedScan, ...]]


@pytest.fixture(scope="module")
def office() -> Office:
    """A map of an office's first three scans, and all fourteen with drifted priors."""
    scans = visit(small_office(1), 14, seed=1, prior_error=(0.1, 2.0))
    fused: Voxels | None = None
    for each in scans[:3]:
        voxels = Voxels.of(each.world_points, size=0.05, origin=each.world_from_sensor[:3, 3])
        fused = voxels if fused is None else fused.merged(voxels)
    assert fused is not None
    return surface_of(fused, SETTINGS), scans


def test_a_scan_that_fits_as_well_a_decimetre_away_is_left_out(office: Office) -> None:
    target, scans = office
    with pytest.raises(ScanRejected, match=r"fits as well \d+ cm away"):
        register(prepare(as_scan(scans[6].points), SETTINGS), target, prior=scans[6].prior, settings=SETTINGS)


def test_without_the_question_it_would_be_believed_a_decimetre_off(office: Office) -> None:
    target, scans = office
    careless = SETTINGS.model_copy(update={"max_ambiguity_distance": np.inf})
    found = register(
        prepare(as_scan(scans[6].points), SETTINGS), target, prior=scans[6].prior, settings=careless
    )
    assert difference(found.target_from_source, scans[6].world_from_sensor)[0] > 0.08


def test_a_scan_that_shares_as_little_but_fits_in_one_place_is_accepted(office: Office) -> None:
    target, scans = office
    found = register(
        prepare(as_scan(scans[5].points), SETTINGS), target, prior=scans[5].prior, settings=SETTINGS
    )
    assert found.overlap < 0.4
    assert difference(found.target_from_source, scans[5].world_from_sensor)[0] < 0.02
