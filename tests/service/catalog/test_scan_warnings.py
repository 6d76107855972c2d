"""What is odd about a scan goes with it: its clock into every outcome, its file from an outcome to the scan."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from service.catalog.catalog import Catalog
from service.catalog.records import ScanOutcome, ScanWarning
from tests.support.samples import add_map, ply

FAR = ScanWarning(reason="far_points", detail="3 points far away were left out", numbers={"points": 3.0})
PRIOR = ScanWarning(reason="wrong_prior", detail="its prior is off by 2.0 m")


def add_scan(catalog: Catalog, folder: Path, captured_at: datetime | None) -> str:
    path = folder / "hall.ply"
    path.write_bytes(ply())
    scan, _ = catalog.scans.add(
        path, filename="hall.ply", format="ply", size=9, sha256="ab" * 32, captured_at=captured_at
    )
    return scan.scan_id


def test_an_outcome_bears_the_clock_and_the_scan_what_is_odd_about_its_file(
    catalog: Catalog, tmp_path: Path
) -> None:
    add_map(catalog)
    scan_id = add_scan(catalog, tmp_path, datetime(1970, 1, 1, tzinfo=UTC))
    survey, _ = catalog.surveys.create("lobby", scan_ids=[scan_id], model="voxel-net/1")
    for _ in range(2):  # a step may run twice
        outcome = ScanOutcome(scan_id=scan_id, accepted=True, warnings=(FAR, PRIOR))
        catalog.surveys.save_outcomes(survey.survey_id, [outcome])
    (kept,) = catalog.surveys.get(survey.survey_id).scans
    assert [one.reason for one in kept.warnings] == ["clock", "far_points", "wrong_prior"]
    assert [one.reason for one in catalog.scans.get(scan_id).warnings] == ["clock", "far_points"]


def test_a_survey_is_told_of_its_own_clock_alone(catalog: Catalog, tmp_path: Path) -> None:
    add_map(catalog)
    scan_id = add_scan(catalog, tmp_path, None)
    late = datetime(2099, 1, 1, tzinfo=UTC)
    odd, _ = catalog.surveys.create("lobby", scan_ids=[scan_id], model="voxel-net/1", captured_at=late)
    right, _ = catalog.surveys.create("lobby", scan_ids=[scan_id], model="voxel-net/1")
    assert [one.reason for one in odd.warnings] == ["clock"]
    assert right.warnings == ()
