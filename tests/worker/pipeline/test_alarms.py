"""The limit on a region's score, by records of false regions made by hand, and by a map's own scans."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from tests.support.visits import VOXEL, Placed
from worker.detectors.card import MODEL_STORE, QuietRecord
from worker.detectors.detector import Detector
from worker.detectors.store import make_detector, open_detector
from worker.pipeline.alarms import MOST, calibrated, least_score, region_scores, visits_of
from worker.simulation.scenes import random_room
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

NONE = np.empty(0)


def rule() -> Detector:
    """The shipped rule without its record of quiet surveys."""
    card = open_detector(MODEL_STORE, "voxel-rule/1").card
    return make_detector(card.model_copy(update={"quiet": None}), None)


def placed(scan: SimulatedScan) -> Placed:
    return Placed(scan.world_points, scan.world_from_sensor[:3, 3])


@pytest.mark.parametrize(
    ("rate", "limit"),
    [(2.0, 0.0), (1.25, 20.0), (0.5, 40.0), (0.1, 50.0)],
)
def test_the_limit_is_the_least_above_which_alarms_are_as_rare_as_asked(rate: float, limit: float) -> None:
    """Four surveys with eight false regions."""
    false = np.array([50.0, 50, 40, 30, 30, 20, 20, 20])
    assert least_score(false, 4, None, rate) == limit


def test_the_cards_record_counts_as_ten_surveys() -> None:
    record = QuietRecord(surveys=20, scores=(60.0, 25.0))
    assert least_score(NONE, 0, record, 0.1) == 0.0  # two in twenty are as rare as asked
    assert least_score(NONE, 0, record, 0.05) == 25.0
    assert least_score(np.array([80.0, 80.0]), 2, record, 0.1) == 80.0
    assert least_score(NONE, 10, record, 0.05) == 0.0  # ten quiet surveys here halve what is expected


def test_nothing_known_sets_no_limit_and_a_hopeless_map_keeps_large_things() -> None:
    assert least_score(NONE, 0, None, 0.1) == 0.0
    assert least_score(np.full(9, 900.0), 3, None, 0.1) == MOST


def test_scans_are_parted_so_that_each_part_sees_the_whole_way() -> None:
    scans = [placed(scan) for scan in visit(random_room(5), 5, seed=1)]
    parts = visits_of([partial(lambda scan: scan, scan) for scan in scans], voxel_size=VOXEL, parts=2)
    assert [len(part.sights) if part.sights else 0 for part in parts] == [3, 2]
    assert sum(int(part.hits.sum()) for part in parts) == sum(len(scan.points) for scan in scans)


def test_a_map_that_repeats_itself_has_no_false_regions_and_one_that_does_not_has_some() -> None:
    detector = rule()
    first, second = random_room(5), random_room(5)
    added, _ = second.with_added("box", second.movable[0].mesh.at(0.0, 0.0, 1.2))
    scans = [placed(scan) for scan in visit(first, 6, seed=1)]
    halves = visits_of([partial(lambda s: s, s) for s in scans], voxel_size=VOXEL, parts=2)
    quiet = calibrated(halves, detector)
    assert (quiet.surveys, quiet.min_score) == (2, 0.0)
    assert len(quiet.false_scores) == 0
    others = [placed(scan) for scan in visit(added, 4, seed=2)]
    apart = visits_of([partial(lambda s: s, s) for s in others], voxel_size=VOXEL, parts=1)
    together = visits_of([partial(lambda s: s, s) for s in scans], voxel_size=VOXEL, parts=1)
    assert max(region_scores(detector, together[0], apart[0])) > 50
    unlike = calibrated([together[0], apart[0]], detector, alarms_per_survey=0.01)
    assert unlike.min_score > 0


def test_of_one_visit_nothing_is_learned() -> None:
    detector = rule()
    one = visits_of([lambda: placed(visit(random_room(5), 1, seed=1)[0])], voxel_size=VOXEL)
    told = calibrated(one, detector)
    assert (told.surveys, told.min_score) == (0, 0.0)
