"""What counts as right, wrong, in doubt, ambiguous and refused, and that answers are kept as they were given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.placement import ROOM, SETTINGS
from worker.benchmarks.placement import answers
from worker.benchmarks.placement.answers import TrialAnswer, answer, answers_of, scan_answer
from worker.benchmarks.placement.plan import Trial
from worker.benchmarks.placement.surveys import Survey, simulate
from worker.pipeline.registration.diagnosis import Diagnosis, Reason
from worker.pipeline.registration.results import RegistrationResult, ScanFile, ScanResult
from worker.simulation.scenes import rigid

HERE = rigid(1.0, 2.0, 0.3, yaw=30)


def accepted(pose, *warnings: Diagnosis) -> ScanResult:
    registration = RegistrationResult(
        map_from_scan=pose,
        sensor_origin=None,
        fitness=0.9,
        inlier_rmse=0.01,
        overlap=0.8,
        two_way_inlier_ratio=0.7,
        from_global_search=True,
        uncertainty=None,
    )
    return ScanResult.accepted("scan", registration, warnings=warnings, confidence=0.9)


def refused(reason: Reason) -> ScanResult:
    return ScanResult(name="scan", registration=None, diagnosis=Diagnosis(reason=reason, detail="why"))


@pytest.mark.parametrize(
    ("off", "verdict", "good"),
    [
        (rigid(0.02), "right", True),
        (rigid(0.09), "right", False),
        (rigid(0.11), "wrong", False),
        (rigid(yaw=0.4), "right", True),
        (rigid(yaw=0.9), "right", False),
        (rigid(yaw=1.1), "wrong", False),
    ],
)
def test_a_pose_is_right_within_ten_centimetres_and_a_degree_and_good_within_three_and_a_half(
    off, verdict, good
):
    said = scan_answer(accepted(HERE @ off), HERE)
    assert (said.verdict, said.good, said.accepted) == (verdict, good, True)


def test_any_pose_of_a_scan_of_another_place_is_wrong_and_none_is_where_the_survey_is_in_doubt():
    assert scan_answer(accepted(HERE), None).verdict == "wrong"
    doubted = scan_answer(accepted(HERE), HERE, in_doubt=True)
    assert doubted.verdict == "in doubt" and doubted.near
    assert not scan_answer(accepted(HERE), None, in_doubt=True).near


def test_the_error_is_measured_where_the_points_are():
    far, turned = rigid(-4000.0), rigid(yaw=0.01)
    said = scan_answer(accepted(HERE @ turned @ far), HERE @ far, middle=np.array([4000.0, 0.0, 0.0]))
    assert said.verdict == "right" and said.metres == pytest.approx(0.0, abs=1e-6)
    assert scan_answer(accepted(HERE @ turned @ far), HERE @ far).verdict == "wrong"


def test_scans_left_out_are_ambiguous_or_refused_by_their_diagnosis():
    assert scan_answer(refused("ambiguous"), HERE).verdict == "ambiguous"
    said = scan_answer(refused("other_place"), None)
    assert (said.verdict, said.named, said.detail) == ("refused", ("other_place",), "why")


def test_warnings_of_an_accepted_scan_are_named():
    warned = accepted(HERE, Diagnosis(reason="wrong_scale", detail="1.01", numbers={"scale": 1.01}))
    assert scan_answer(warned, HERE).named == ("wrong_scale",)


def test_an_answer_is_read_as_it_was_kept(tmp_path: Path):
    said = TrialAnswer(
        name="a",
        scans=(scan_answer(accepted(HERE), HERE), scan_answer(refused("no_fit"), None)),
        seconds=1.5,
        confidence=0.75,
        in_doubt=True,
    )
    said.keep(tmp_path / "kept" / "a.json")
    assert TrialAnswer.read(tmp_path / "kept" / "a.json") == said


def test_another_file_is_no_answer(tmp_path: Path):
    (tmp_path / "a.json").write_text('{"scans": [{"verdict": "right"}]}')
    with pytest.raises(ValueError, match=r"a\.json is no answer"):
        TrialAnswer.read(tmp_path / "a.json")


def test_a_file_that_cannot_be_read_is_refused_as_unreadable(site, tmp_path: Path):
    (tmp_path / "empty.pcd").write_bytes(b"")
    survey = Survey(files=(ScanFile(name="empty", path=tmp_path / "empty.pcd"),), true=(None,))
    (said,) = answer("a", survey, site, SETTINGS.pipeline).scans
    assert (said.verdict, said.reason) == ("refused", "unreadable")


def test_the_placement_of_a_survey_puts_its_scans_in_doubt(site, tmp_path: Path, monkeypatch):
    trial = Trial(site=ROOM, number=1, kind="right", prior=True)
    survey = simulate(trial, site, SETTINGS, tmp_path)
    sure = answer("a", survey, site, SETTINGS.pipeline)
    assert sure.scans[0].verdict == "right"
    assert sure.scans[0].good

    class Doubtful:
        outcomes = (accepted(survey.true[0]),)

        class placement:  # noqa: N801 — stands for a field
            confidence, in_doubt = 0.2, True

    monkeypatch.setattr(answers, "locate_survey", lambda *_, **__: Doubtful)
    said = answer("a", survey, site, SETTINGS.pipeline)
    assert (said.confidence, said.in_doubt, said.scans[0].verdict) == (0.2, True, "in doubt")


def test_kept_answers_are_not_asked_for_again_until_the_code_is_another(folder, site, monkeypatch):
    trial = Trial(site=ROOM, number=1, kind="right", prior=True)
    asked: list[str] = []

    def fake(task):
        asked.append(task.trial.name)
        scans = (scan_answer(accepted(HERE), HERE),)
        TrialAnswer(name=task.trial.name, scans=scans, seconds=0.1).keep(task.kept)

    monkeypatch.setattr(answers, "_answer_and_keep", fake)
    monkeypatch.setattr(answers, "code_fingerprint", lambda: "one")
    first = answers_of([trial], SETTINGS, folder, processes=1)
    assert answers_of([trial], SETTINGS, folder, processes=1) == first
    assert asked == [trial.name]
    monkeypatch.setattr(answers, "code_fingerprint", lambda: "another")
    answers_of([trial, replace(trial, number=2)], SETTINGS, folder, processes=1)
    assert len(asked) == 3
    assert site.reference.points.dtype == np.float32
