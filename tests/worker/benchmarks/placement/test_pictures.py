"""What is marked in the pictures of impostors, and which impostors are drawn."""

from __future__ import annotations

from tests.support.placement import ROOM, SETTINGS
from worker.benchmarks.placement.answers import ScanAnswer, TrialAnswer
from worker.benchmarks.placement.measures import Answered
from worker.benchmarks.placement.pictures import draw_impostors, in_turn
from worker.benchmarks.placement.plan import Trial


def answered(kind, number, pose=None):
    trial = Trial(site=ROOM, number=number, kind=kind)
    flat = None if pose is None else tuple(pose.ravel().tolist())
    said = ScanAnswer(verdict="refused", here=False, accepted=False, reason="other_place", pose=flat)
    return Answered(trial=trial, answer=TrialAnswer(name=trial.name, scans=(said,), seconds=1.0))


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
