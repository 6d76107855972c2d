"""Figures of a map whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.registration.assessment import assess
from worker.cloud.types import Matrix4
from worker.pipeline.registration.results import RegistrationResult, ScanResult, Uncertainty
from worker.simulation.scenes import rigid

MAP_FROM_WORLD = rigid(3.0, 4.0, yaw=50.0)
WALK = [rigid(2.0 * step, 0.1 * step**2, 0.35, yaw=15.0 * step) for step in range(9)]


def outcome(name: str, pose: Matrix4 | None, sigma: float | None = 0.01) -> ScanResult:
    if pose is None:
        return ScanResult(name=name, registration=None, diagnosis=None)
    uncertainty = None if sigma is None else Uncertainty(translation=sigma, rotation=np.radians(0.1))
    registration = RegistrationResult(
        map_from_scan=pose,
        sensor_origin=None,
        fitness=0.7,
        inlier_rmse=0.02,
        overlap=0.8,
        two_way_inlier_ratio=0.9,
        from_global_search=False,
        uncertainty=uncertainty,
        path=(),
    )
    return ScanResult(name=name, registration=registration, fitness=0.7, inlier_rmse=0.02)


def test_errors_are_counted_after_alignment_and_by_scan() -> None:
    poses = [MAP_FROM_WORLD @ pose for pose in WALK]
    poses[3] = poses[3] @ rigid(0.5)  # half a metre ahead of where it was
    poses[5] = poses[5] @ rigid(yaw=2.0)
    outcomes = [outcome(f"scan-{at}", pose) for at, pose in enumerate(poses)]
    told = assess(outcomes, WALK).document()
    assert (told["accepted"], told["of"], told["wrong"]) == (9, 9, 1)
    assert told["centimetres"]["worst"] == pytest.approx(50.0, abs=1.0)
    assert told["centimetres"]["median"] < 1.0
    assert told["scans"][3]["name"] == "scan-3"
    assert told["scans"][3]["centimetres"] == told["centimetres"]["worst"]
    assert told["degrees"]["worst"] == pytest.approx(2.0, abs=0.3)


def test_calibration_compares_each_error_with_its_own_sigma() -> None:
    rng = np.random.default_rng(0)
    sigmas = np.tile([0.005, 0.02], 100)
    walk = [rigid(float(at), 0.0) for at in range(200)]
    poses = [
        MAP_FROM_WORLD @ pose @ rigid(*(rng.normal(0, sigma, 3) * (1, 0, 0)).tolist())
        for pose, sigma in zip(walk, sigmas, strict=True)
    ]
    poses[0] = MAP_FROM_WORLD @ walk[0]  # the reference
    outcomes = [
        outcome(str(at), pose, sigma) for at, (pose, sigma) in enumerate(zip(poses, sigmas, strict=True))
    ]
    told = assess(outcomes, walk, reference=0).document()["translation_sigma"]
    assert told["within_2_sigma"] == pytest.approx(0.954, abs=0.04)  # of a normal error on one axis
    assert told["median_error_over_sigma"] == pytest.approx(0.674, abs=0.1)


def test_a_scan_without_a_stated_sigma_has_no_say_in_calibration() -> None:
    poses = [MAP_FROM_WORLD @ pose for pose in WALK]
    poses[1] = poses[1] @ rigid(0.005)
    outcomes = [outcome(f"scan-{at}", pose) for at, pose in enumerate(poses)]
    bare = outcome("scan-0", poses[0], sigma=None)
    told = assess([bare, *outcomes[1:]], WALK, reference=4).document()
    assert told["scans"][0]["sigma_centimetres"] is None
    assert told["translation_sigma"]["within_2_sigma"] == 1.0


def test_what_sigma_speaks_of_is_seen_from_the_reference_scan() -> None:
    poses = [MAP_FROM_WORLD @ pose for pose in WALK]
    poses[4] = poses[4] @ rigid(0.03)  # the reference itself is off, so all others are, seen from there
    outcomes = [outcome(f"scan-{at}", pose) for at, pose in enumerate(poses)]
    told = assess(outcomes, WALK, reference=4).document()
    assert told["centimetres"]["median"] < 0.5
    seen = [row["from_reference_centimetres"] for row in told["scans"]]
    assert seen[4] is None
    assert seen[:4] + seen[5:] == pytest.approx([3.0] * 8)
    assert told["translation_sigma"] == pytest.approx({"within_2_sigma": 0.0, "median_error_over_sigma": 3.0})
    assert assess(outcomes, WALK).document()["translation_sigma"] is None


def test_out_of_place_and_missing_scans_are_named_and_bend_nothing() -> None:
    poses: list[Matrix4 | None] = [MAP_FROM_WORLD @ pose for pose in WALK]
    poses[2] = None
    outcomes = [outcome(f"scan-{at}", pose) for at, pose in enumerate(poses)]
    outcomes += [outcome("foreign-1", rigid(99.0)), outcome("foreign-2", None)]
    found = assess(outcomes, [*WALK, None, None])
    assert (found.missing, found.foreign_accepted) == (("scan-2",), ("foreign-1",))
    told = found.document()
    assert (told["accepted"], told["foreign_accepted"], told["foreign"]) == (8, 1, 2)
    assert told["centimetres"]["worst"] == pytest.approx(0.0, abs=1e-6)


def test_a_map_of_nothing_but_out_of_place_scans_has_no_errors() -> None:
    told = assess([outcome("scan-1", None), outcome("foreign-1", np.eye(4))], [np.eye(4), None]).document()
    assert (told["accepted"], told["centimetres"], told["translation_sigma"]) == (0, None, None)
