"""What became of scans, as it is recorded."""

from __future__ import annotations

from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest

from service.catalog.records import Placement, ScanOutcome, ScanReason
from tests.support.samples import IDENTITY
from worker.errors import ScanError
from worker.jobs.scans import kept_placement, recorded_placement, scan_files, scan_outcomes, unread
from worker.pipeline.registration.diagnosis import MEANING, REASONS, Diagnosis
from worker.pipeline.registration.results import (
    RegistrationResult,
    ScanFile,
    ScanRejected,
    ScanResult,
    SurveyPlacement,
)
from worker.pipeline.settings import PipelineSettings

ASKED = (ScanOutcome(scan_id="scan-1"),)


def recorded(result: ScanResult) -> ScanOutcome:
    (outcome,) = scan_outcomes(ASKED, (result,))
    return outcome


def accepted(*warnings: Diagnosis) -> ScanResult:
    registration = RegistrationResult(
        map_from_scan=np.eye(4),
        sensor_origin=None,
        fitness=0.9,
        inlier_rmse=0.02,
        overlap=0.8,
        two_way_inlier_ratio=0.9,
        from_global_search=False,
        uncertainty=None,
    )
    return ScanResult.accepted("hall.pcd", registration, warnings=warnings, confidence=0.97)


def test_the_service_and_the_worker_have_the_same_reasons() -> None:
    assert get_args(ScanReason) == REASONS == tuple(MEANING)


def test_a_scan_that_was_left_out_is_recorded_with_reason_sentence_and_numbers() -> None:
    error = ScanRejected.because("wrong_scale", "hall.pcd: its scale is 1.030", scale=1.03, residual=0.2)
    outcome = recorded(ScanResult.rejected("hall.pcd", error))
    assert (outcome.accepted, outcome.reason) == (False, "wrong_scale")
    assert outcome.detail == "hall.pcd: its scale is 1.030"
    assert outcome.numbers == {"scale": 1.03, "residual": 0.2}
    assert (outcome.candidates, outcome.warnings, outcome.confidence) == (None, (), None)


def test_a_number_that_could_not_be_measured_is_left_out() -> None:
    error = ScanRejected.because("no_fit", "hall.pcd: no fit", fitness=0.1, rmse=float("nan"))
    assert recorded(ScanResult.rejected("hall.pcd", error)).numbers == {"fitness": 0.1}


def test_the_poses_that_nothing_tells_apart_are_recorded_as_candidates() -> None:
    other = np.eye(4)
    other[0, 3] = 2.5
    diagnosis = Diagnosis(reason="ambiguous", detail="two poses", poses=(np.eye(4), other))
    outcome = recorded(ScanResult.rejected("hall.pcd", ScanRejected(diagnosis)))
    assert outcome.candidates == (IDENTITY, ((1, 0, 0, 2.5), *IDENTITY[1:]))


def test_an_accepted_scan_is_recorded_with_its_confidence_and_what_is_odd_about_it() -> None:
    odd = Diagnosis(reason="wrong_scale", detail="its scale is 1.012", numbers={"scale": 1.012})
    outcome = recorded(accepted(odd))
    assert (outcome.accepted, outcome.reason, outcome.detail, outcome.numbers) == (True, None, None, None)
    assert outcome.confidence == 0.97
    (warning,) = outcome.warnings
    assert warning.model_dump() == {
        "reason": "wrong_scale",
        "detail": "its scale is 1.012",
        "numbers": {"scale": 1.012},
    }


@pytest.mark.parametrize(("in_doubt", "state"), [(True, "in_doubt"), (False, "confirmed")])
def test_a_placement_is_read_as_it_was_recorded(in_doubt: bool, state: str) -> None:
    placement = SurveyPlacement(confidence=0.71, in_doubt=in_doubt)
    kept = recorded_placement(placement)
    assert kept.model_dump() == {"state": state, "confidence": 0.71}
    assert kept_placement(kept) == placement


@pytest.mark.parametrize("kept", [None, Placement(state="refused", confidence=None)])
def test_where_nobody_judged_a_placement_it_is_not_in_doubt(kept: Placement | None) -> None:
    assert kept_placement(kept) is None


def test_of_files_that_cannot_be_read_each_has_its_own_sentence(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("hello")
    (tmp_path / "b").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    files = [ScanFile(name=f"{name}.ply", path=tmp_path / name) for name in ("a", "b")]
    results = unread(files, ScanError("a.ply: neither PLY, PCD, E57 nor LAS"), max_points=100)
    assert [str(result.reason).partition(":")[0] for result in results] == ["a.ply", "b.ply"]
    assert {result.diagnosis.reason for result in results if result.diagnosis} == {"unreadable"}


def test_a_scan_is_registered_from_the_pose_of_its_use_and_not_from_that_of_its_upload(
    tmp_path: Path,
) -> None:
    path = tmp_path / "hall.ply"
    path.write_bytes(b"ply")
    upload = SimpleNamespace(key="a", filename="hall.ply", pose=IDENTITY)
    catalog: Any = SimpleNamespace(
        scans=SimpleNamespace(get=lambda _: upload), blobs=SimpleNamespace(local=lambda _: nullcontext(path))
    )
    moved = ((1, 0, 0, 4), *IDENTITY[1:])
    asked = [ScanOutcome(scan_id="scan-1", pose=moved), ScanOutcome(scan_id="scan-2")]
    settings = PipelineSettings.model_validate({})
    with ExitStack() as stack:
        context: Any = SimpleNamespace(catalog=catalog)
        one, other = scan_files(context, asked, stack, settings, refused={})
    assert one.pose is not None
    np.testing.assert_array_equal(one.pose, moved)
    assert other.pose is None
