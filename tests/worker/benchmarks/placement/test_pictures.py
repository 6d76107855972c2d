"""What is marked in the pictures of impostors, and which impostors are drawn."""

from __future__ import annotations

import numpy as np

from tests.support.placement import ROOM, SETTINGS
from worker.benchmarks.placement.answers import ScanAnswer, TrialAnswer
from worker.benchmarks.placement.measures import Answered
from worker.benchmarks.placement.pictures import draw_impostors, in_turn, seen_through
from worker.benchmarks.placement.plan import Trial
from worker.benchmarks.placement.surveys import trial_scans
from worker.cloud.poses import transformed


def answered(kind, number, pose=None):
    trial = Trial(site=ROOM, number=number, kind=kind)
    flat = None if pose is None else tuple(pose.ravel().tolist())
    said = ScanAnswer(verdict="refused", here=False, accepted=False, reason="other_place", pose=flat)
    return Answered(trial=trial, answer=TrialAnswer(name=trial.name, scans=(said,), seconds=1.0))


def shares(scan, pose, site):
    points = transformed(scan.points, pose).astype(np.float32)
    told = seen_through(points, pose[:3, 3], site)
    assert told.scan.shape == (len(points),) and told.map.shape == (len(site.reference.points),)
    return told.scan.mean(), told.map.mean()


def test_a_scan_at_a_wrong_pose_is_contradicted_both_ways_and_a_right_one_is_not(site):
    (right,) = trial_scans(Trial(site=ROOM, number=1, kind="right"), site, SETTINGS)
    (twin,) = trial_scans(Trial(site=ROOM, number=1, kind="twin"), site, SETTINGS)
    wrong = site.map_from_world @ site.stops[0]
    mine, its = shares(right, right.true, site), shares(twin, wrong, site)
    assert max(mine) < 0.01
    assert min(its) > 0.03


def test_pictures_are_of_every_kind_in_turn():
    trials = [answered("other", number) for number in range(3)] + [answered("twin", 7)]
    kinds = [one.trial.kind for one in in_turn(trials)]
    assert kinds == ["other", "twin", "other", "other"]
    assert len({one.trial.name for one in in_turn(trials)}) == 4


def test_a_picture_is_written_at_the_pose_that_was_told_or_at_the_best_there_is(site, folder):
    pose = site.map_from_world @ site.stops[0]
    trials = [answered("other", 1), answered("right", 3), answered("twin", 2, pose)]
    names = draw_impostors(trials, SETTINGS, folder, 5)
    assert names == [f"impostor-{ROOM.name}-001-other.png", f"impostor-{ROOM.name}-002-twin.png"]
    assert all((folder / name).read_bytes().startswith(b"\x89PNG") for name in names)
