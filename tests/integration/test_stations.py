"""An E57 of several stations becomes a scan for each, when a map or a survey first reads it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import pytest

from service.catalog.records import ScanRecord
from tests.support.clouds import damage_station, write_e57
from tests.support.house import House, run
from worker import jobs
from worker.cloud.poses import difference, inverse, translation
from worker.errors import ScanError
from worker.jobs import stations


def add_e57(
    house: House, *, frame: np.ndarray, damaged: Sequence[int] = (), cut_to: int | None = None
) -> ScanRecord:
    """The map's two scans as one file, whose own frame is `frame` (file_from_world); some stations are damaged."""
    scans = house.material.before
    path = write_e57(
        house.folder / "lobby.e57",
        [scan.points for scan in scans],
        poses=[frame @ scan.world_from_sensor for scan in scans],
        names=["by the door", ""],
    )
    for number in damaged:
        damage_station(path, number)
    path.write_bytes(path.read_bytes()[:cut_to])
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    size = path.stat().st_size
    record, _ = house.catalog.scans.add(
        path, filename="lobby.e57", format="e57", size=size, sha256=digest, device_id="tripod"
    )
    return record


def test_a_map_of_one_e57_has_a_scan_for_each_station_at_its_pose(house: House) -> None:
    frame = translation(np.array([500_000.0, 5_400_000.0, 120.0]))  # a country's grid
    file = add_e57(house, frame=frame)
    job = house.map_of(file, map_id="hall")
    run(job, "register")
    run(job, "register")  # a step may run twice
    version = house.catalog.versions.of_job(job.job_id)
    names = [house.catalog.scans.get(scan.scan_id).filename for scan in version.scans]
    assert names == ["lobby-001-by_the_door.pcd", "lobby-002.pcd"]
    assert [scan.accepted for scan in version.scans] == [True, True]
    one, two = (np.array(scan.map_from_scan) for scan in version.scans)
    first, second = (scan.world_from_sensor for scan in house.material.before)
    assert difference(inverse(one) @ two, inverse(first) @ second)[0] < 0.02
    assert (
        np.abs(np.array([scan.pose for scan in version.scans])[:, :3, 3]).max() < 200
    )  # the grid's offset is off
    assert house.catalog.scans.get(file.scan_id).format == "e57"  # the file stays as it came


@pytest.mark.parametrize("given", [False, True])
def test_a_survey_takes_a_file_apart_and_a_pose_of_the_file_counts_for_all_of_it(
    house: House, given: bool
) -> None:
    file = add_e57(house, frame=np.eye(4))
    if given:
        file = house.catalog.scans.correct(file.scan_id, pose=translation(np.array([0.01, 0, 0])).tolist())
    job = house.survey_of(file)
    jobs.register_survey(job.job_id)
    survey = house.survey(job)
    assert [scan.accepted for scan in survey.scans] == [True, True]
    for scan, known in zip(survey.scans, house.material.before, strict=True):
        assert difference(np.array(scan.map_from_scan), known.world_from_sensor)[0] < 0.02
        shift = np.array(scan.pose)[:3, 3] - known.world_from_sensor[:3, 3]
        assert shift == pytest.approx([0.01 if given else 0, 0, 0], abs=1e-6)


@pytest.mark.parametrize("damaged", [0, 1])
def test_stations_that_can_be_read_count_and_the_other_is_named_with_its_reason(
    house: House, damaged: int
) -> None:
    sound = house.material.before[1 - damaged]
    file = add_e57(house, frame=np.eye(4), damaged=[damaged])
    job = house.survey_of(file)
    for _ in range(2):  # a step may run twice
        run(job, "register")
        station, rest = house.survey(job).scans
        assert station.accepted
        assert difference(np.array(station.map_from_scan), sound.world_from_sensor)[0] < 0.02
        assert station.pose == pytest.approx(sound.world_from_sensor)
        assert (rest.scan_id, rest.accepted, rest.reason) == (file.scan_id, False, "unreadable")
        name = ("station 1 (by the door)", "station 2")[damaged]
        told = f"lobby.e57: 1 of 2 stations cannot be read, the others are scans of their own: {name}: its points are"
        assert (rest.detail or "").startswith(told)
    assert house.survey(job).accepted_count == 1


def test_a_map_is_built_of_the_stations_that_can_be_read(house: House) -> None:
    file = add_e57(house, frame=np.eye(4), damaged=[1])
    job = house.map_of(file, map_id="hall")
    run(job, "register")
    version = house.catalog.versions.of_job(job.job_id)
    assert [scan.accepted for scan in version.scans] == [True, False]
    assert version.scans[1].scan_id == file.scan_id


@pytest.mark.parametrize(
    ("damaged", "cut_to", "most", "told"),
    [
        (
            [0, 1],
            None,
            10,
            "2 of 2 stations cannot be read, none is left: station 1 (by the door): its points",
        ),
        ([0], None, 0, "1 of 2 stations cannot be read, too many of them, so the file is damaged: station 1"),
        ([], -1024, 10, "truncated: header declares"),
    ],
)
def test_a_file_of_which_nothing_can_be_trusted_is_left_out_as_a_whole(
    house: House,
    monkeypatch: pytest.MonkeyPatch,
    damaged: list[int],
    cut_to: int | None,
    most: int,
    told: str,
) -> None:
    monkeypatch.setattr(stations, "MOST_REFUSED", most)
    file = add_e57(house, frame=np.eye(4), damaged=damaged, cut_to=cut_to)
    job = house.survey_of(file)
    with pytest.raises(ScanError):
        run(job, "register")
    (scan,) = house.survey(job).scans
    assert (scan.scan_id, scan.accepted, scan.reason) == (file.scan_id, False, "unreadable")
    assert told in (scan.detail or "")
