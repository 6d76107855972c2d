"""Short scans of a furnished room: surfaces alone are content with a pose half a metre off."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.walks import MANY, off
from worker.benchmarks.trajectory import map_frame, scan_files
from worker.pipeline.flow import build_map
from worker.pipeline.mapping.survey_registration import register_survey_scans
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.scan_to_map import register
from worker.pipeline.settings import PipelineSettings
from worker.simulation.scenes import random_room
from worker.simulation.visits import DRIFT, drifted_within, edited, visit


@pytest.mark.slow
def test_a_scan_that_surfaces_lay_half_a_metre_off_is_told_by_what_rays_went_through(tmp_path: Path) -> None:
    """Three stops of two seconds in a room of which surfaces alone believe one pose 45 cm off; none is believed now."""
    scene = random_room(51)
    before = visit(
        scene, 3, seed=9020, duration_s=2.0, prior_error=DRIFT, drift=drifted_within, folder=tmp_path
    )
    now, _ = edited(scene, 3, seed=8, count=3)
    after = visit(
        now,
        3,
        seed=9021,
        duration_s=2.0,
        prior_error=DRIFT,
        drift=drifted_within,
        folder=tmp_path,
        name="now-{}",
    )
    built = build_map(scan_files(before), settings=PipelineSettings(), processes=1)
    map_from_world = map_frame(built.outcomes, before)
    target, settings = built.reference.surface(), PipelineSettings().joint_registration
    true = [map_from_world @ scan.world_from_sensor for scan in after]
    (alone, *_) = scan_files(after)
    scan = prepare(alone.read(max_points=MANY), settings.registration)
    by_surfaces = register(
        scan, target, prior=alone.prior(scan.sensor_pose), settings=settings.registration
    ).target_from_source
    assert off(by_surfaces, true[0]) > 0.2
    found = register_survey_scans(
        scan_files(after), target, settings=settings, sights=built.seen.sights, processes=1
    )
    placed = [outcome.registration for outcome in found.outcomes]
    assert sum(one is not None for one in placed) >= 2
    for one, pose in zip(placed, true, strict=True):
        assert one is None or off(one.map_from_scan, pose) < 0.05
