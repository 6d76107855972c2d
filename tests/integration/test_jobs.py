"""The steps of a job, called in order in this process on a real catalog, with a network of random weights."""

from __future__ import annotations

import errno
import json
from contextlib import AbstractContextManager
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.jobs import Jobs, Run
from service.catalog.records import JobRecord, Placement, Problem, ScanRecord, Tileset
from service.catalog.steps import STEPS, JobKind
from service.errors import DatabaseUnavailable
from service.settings import Settings
from tests.support.house import MAP, MODEL, OTHER_CUT, SAME_CUT, SEEN_TO, House, Material, run
from tests.support.tilesets import content_in, tiles_of
from worker import jobs
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import difference
from worker.cloud.tilesets.glb import LINEAR_BYTES
from worker.cloud.types import Points
from worker.detectors.store import open_card
from worker.errors import DetectorUnavailable, MapFailed, NoSpaceLeft, ScanError
from worker.jobs.surveys import scoring
from worker.pipeline.flow import NoScanAccepted
from worker.pipeline.registration.diagnosis import REASONS
from worker.scratch import scratch_folder


@pytest.fixture
def visited(house: House) -> JobRecord:
    """A survey that waits, of the scan whose survey is done: one of a later visit, which saw half of the room."""
    done = house.survey(house.done[0])
    return house.survey_of(house.catalog.scans.get(done.scans[0].scan_id))


def run_until_killed(job: JobRecord, name: str) -> None:
    """The step in a process that is killed when all is written and the job is not yet marked as done."""

    def killed(self: Jobs, job_id: str, *, run: Run) -> bool:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Jobs, "succeed", killed)
        with pytest.raises(KeyboardInterrupt):
            run(job, name)


def embedding_key(house: House, model: str) -> str:
    """Of what this model's weights said of the map."""
    card = open_card(house.material.model_store, model)
    return blob_keys.map_embedding(house.catalog.maps.get(MAP).job_id, model, card.fingerprint)


def failed(house: House, job: JobRecord, code: str) -> str:
    """The sentence of a job that failed with this code."""
    found = house.catalog.jobs.get(job.job_id)
    assert found.status == "failed"
    assert found.problem is not None
    assert found.problem.code == code
    return found.problem.detail


def test_a_map_is_ready_with_its_counts_scans_and_files(house: House) -> None:
    found = house.catalog.maps.get(MAP)
    assert house.catalog.jobs.get(found.job_id).progress == 100
    assert found.counts["scans"] == found.counts["accepted"] == 2
    assert found.counts["tiles"] > 15
    for outcome, scan in zip(found.scans, house.material.before, strict=True):
        assert outcome.accepted
        assert difference(np.array(outcome.map_from_scan), scan.world_from_sensor)[0] < 0.015
        assert house.catalog.blobs.exists(
            blob_keys.map_scan(house.catalog.maps.get(MAP).job_id, outcome.scan_id)
        )
    with house.catalog.blobs.local(blob_keys.map_cloud(house.catalog.maps.get(MAP).job_id)) as path:
        assert len(read_scan(path).points) == found.counts["points"]
    with house.catalog.blobs.local(blob_keys.map_laz(house.catalog.maps.get(MAP).job_id)) as path:
        assert len(read_scan(path).points) == found.counts["points"]
    listing = json.loads(
        house.catalog.blobs.get_bytes(blob_keys.map_manifest(house.catalog.maps.get(MAP).job_id))
    )
    assert listing["n_valid_patches"] == found.counts["tiles"]
    assert found.bounds is not None
    assert found.bounds.max == pytest.approx(listing["map_bounds"]["max"])
    assert house.catalog.blobs.exists(embedding_key(house, MODEL))


def test_a_map_has_a_tileset_of_its_cloud(house: House) -> None:
    found, blobs = house.catalog.maps.ready(MAP), house.catalog.blobs
    document = json.loads(blobs.get_bytes(blob_keys.map_tileset(found.job_id)))
    contents = blobs.get_bytes(blob_keys.map_tileset_contents(found.job_id))
    with blobs.local(blob_keys.map_cloud(found.job_id)) as path:
        points = read_scan(path).points
    assert_tileset(found.tileset, document, contents, points)


def assert_tileset(told: Tileset | None, document: Any, contents: bytes, points: Points) -> None:
    """A tileset holds the points, and the record says how many."""
    read = content_in(contents)
    parts = [read(tile.uri) for tile in tiles_of(document) if tile.uri is not None]
    decoded = np.concatenate([part.points for part in parts])
    distance, rows = cKDTree(points).query(decoded)
    assert len(np.unique(rows)) == len(rows) == len(points)
    assert distance.max() < max(part.step for part in parts)
    assert told is not None
    assert (told.n_points, told.contents, told.bytes) == (len(points), len(parts), len(contents))
    assert all(tile.uri is None or told.sha256[:16] in tile.uri for tile in tiles_of(document))


def test_a_large_survey_has_a_tileset_of_its_coloured_cloud(
    house: House, visited: JobRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert house.survey(house.done[0]).tileset is None  # small enough to be read whole
    monkeypatch.setattr("worker.jobs.surveys.READ_WHOLE", 100)
    run(visited)
    survey, blobs = house.survey(visited), house.catalog.blobs
    document = json.loads(blobs.get_bytes(blob_keys.survey_tileset(survey.survey_id)))
    contents = blobs.get_bytes(blob_keys.survey_tileset_contents(survey.survey_id))
    with blobs.local(blob_keys.survey_cloud(survey.survey_id)) as path:
        cloud = read_scan(path)
    assert_tileset(survey.tileset, document, contents, cloud.points)
    part = content_in(contents)(str(document["root"]["content"]["uri"]))
    _, rows = cKDTree(cloud.points).query(part.points)
    assert cloud.colors is not None
    assert np.array_equal(part.attributes["COLOR_0"][:, :3], LINEAR_BYTES[cloud.colors[rows]])


def test_a_survey_is_ready_with_a_state_for_every_tile_of_the_map(house: House) -> None:
    job = house.done[0]
    survey = house.survey(job)
    assert (job.status, job.progress, survey.status) == ("successful", 100, "ready")
    assert survey.threshold == 0.4  # the card's
    assert survey.scans[0].accepted
    truth = house.material.after.world_from_sensor
    assert difference(np.array(survey.scans[0].map_from_scan), truth)[0] < 0.02
    tiles = house.tiles(survey.survey_id)
    assert len(tiles) == survey.counts["tiles"] == house.catalog.maps.get(MAP).counts["tiles"]
    states = [tile["state"] for tile in tiles]
    assert {state: states.count(state) for state in set(states)}.items() <= survey.counts.items()
    blind = [tile["state"] for tile in tiles if tile["bounds"]["min"][0] > SEEN_TO]
    assert blind
    assert set(blind) == {"unobserved"}
    assert any(state != "unobserved" for state in states)


def test_a_survey_leaves_a_cloud_a_picture_and_its_scan(house: House) -> None:
    survey, blobs = house.survey(house.done[0]), house.catalog.blobs
    assert blobs.get_bytes(blob_keys.survey_picture(survey.survey_id)).startswith(b"\x89PNG")
    with blobs.local(blob_keys.survey_cloud(survey.survey_id)) as path:
        cloud = read_scan(path)
    with blobs.local(blob_keys.survey_laz(survey.survey_id)) as path:
        packed = read_scan(path)
    assert np.abs(packed.points - cloud.points).max() < 6e-4
    assert packed.colors is not None
    assert cloud.colors is not None
    assert np.array_equal(packed.colors, cloud.colors)
    assert cloud.points[:, 0].max() < SEEN_TO + 0.1
    assert blobs.exists(blob_keys.survey_scan(survey.survey_id, survey.scans[0].scan_id))


def test_a_threshold_of_0_finds_every_observed_tile_changed(house: House) -> None:
    survey = house.survey(house.done[1])
    assert survey.threshold == 0.0
    assert survey.counts["changed"] > 0
    assert survey.counts["changed"] + survey.counts["unobserved"] == survey.counts["tiles"]


def test_a_model_that_cuts_alike_scores_a_map_that_was_described_for_another(house: House) -> None:
    ours, theirs = (house.tiles(house.survey(job).survey_id) for job in house.done)
    assert house.survey(house.done[1]).model == SAME_CUT
    assert not house.catalog.blobs.exists(embedding_key(house, SAME_CUT))
    assert len(ours) == len(theirs)
    for one, two in zip(ours, theirs, strict=True):  # the same weights under another name
        assert one["score"] == pytest.approx(two["score"], abs=1e-4)


def test_progress_never_falls_and_names_the_stages_in_order(material: Material) -> None:
    shares = [share for _, share in material.told]
    assert shares == sorted(shares)
    stages = list(dict.fromkeys(stage for stage, _ in material.told))
    assert stages == ["registering", "tiling", "saving", "scoring", "exporting"]


def test_steps_leave_nothing_in_the_temporary_folder(material: Material) -> None:
    assert material.left == []


def test_each_step_of_a_survey_may_run_twice(house: House, visited: JobRecord) -> None:
    for name in ("register", "score"):
        run(visited, name)
        once = house.files(), house.survey(visited).scans
        run(visited, name)
        assert (house.files(), house.survey(visited).scans) == once
    run_until_killed(visited, "export")
    survey = house.survey(visited)
    assert survey.status == "running"
    files, tiles = house.files(), house.tiles(survey.survey_id)
    assert tiles
    run(visited, "export")
    assert house.files() == files
    assert house.tiles(survey.survey_id) == tiles
    assert house.survey(visited).status == "ready"


def test_each_step_of_a_map_may_run_twice(house: House) -> None:
    job = house.map_of(
        *(house.catalog.scans.get(outcome.scan_id) for outcome in house.catalog.maps.get(MAP).scans),
        map_id="again",
    )
    run(job, "register")
    files, record = house.files(), house.catalog.maps.get("again")
    run(job, "register")
    assert house.files() == files
    assert house.catalog.maps.get("again").model_dump(exclude={"updated"}) == record.model_dump(
        exclude={"updated"}
    )
    run_until_killed(job, "encode")
    files = house.files()
    run(job, "encode")
    assert house.files() == files
    made, first = (
        {name.removeprefix(folder): found for name, found in files.items() if name.startswith(folder)}
        for folder in (blob_keys.map_folder(house.catalog.maps.get(name).job_id) for name in ("again", MAP))
    )
    assert made == first != {}  # the same scans give the same map, to the byte


def test_a_build_that_is_killed_between_the_files_of_its_tileset_makes_the_same_again(house: House) -> None:
    first, blobs = house.catalog.maps.get(MAP), house.catalog.blobs
    scans = (house.catalog.scans.get(outcome.scan_id) for outcome in first.scans)
    job = house.map_of(*scans, map_id="again")
    put = Blobs.put_file

    def killed(self: Blobs, key: str, path: Path, *, move: bool = False) -> None:
        if key == blob_keys.map_tileset(job.job_id):
            raise KeyboardInterrupt
        put(self, key, path, move=move)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Blobs, "put_file", killed)
        with pytest.raises(KeyboardInterrupt):
            run(job, "register")
    assert blobs.exists(blob_keys.map_tileset_contents(job.job_id))
    assert not blobs.exists(blob_keys.map_tileset(job.job_id))
    assert house.catalog.maps.get("again").tileset is None  # so nobody is led to it
    run(job, "register")
    assert house.catalog.maps.get("again").tileset == first.tileset
    for key in (blob_keys.map_tileset, blob_keys.map_tileset_contents):
        assert blobs.get_bytes(key(job.job_id)) == blobs.get_bytes(key(first.job_id))


def test_a_finished_job_is_left_alone(house: House) -> None:
    files, (job, _) = house.files(), house.done
    run(job)
    assert house.files() == files
    assert house.done[0] == job


def test_no_step_of_a_dismissed_job_does_anything(house: House, visited: JobRecord) -> None:
    built = house.map_of(house.add("one.pcd", house.material.before[1]), map_id="hall")
    for job in (visited, built):
        house.catalog.jobs.dismiss(job.job_id)
    files = house.files()
    for job in (visited, built):
        run(job)
        assert house.catalog.jobs.get(job.job_id).status == "dismissed"
    assert house.files() == files
    assert house.survey(visited).scans[0].accepted is None
    assert house.catalog.maps.get("hall").scans[0].accepted is None


@pytest.mark.parametrize("name", ["register", "score", "export"])
def test_a_job_dismissed_while_a_step_works_stops_there(
    house: House, visited: JobRecord, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    before = [step.name for step in STEPS["survey"]]
    for earlier in before[: before.index(name)]:
        run(visited, earlier)
    real, files = Jobs.report, house.files()

    def dismissed_meanwhile(self: Jobs, of: Run, *, message: str, progress: float) -> bool:
        self.dismiss(of.job_id)
        return real(self, of, message=message, progress=progress)

    monkeypatch.setattr(Jobs, "report", dismissed_meanwhile)
    run(visited, name)
    assert house.catalog.jobs.get(visited.job_id).status == "dismissed"
    assert house.files() == files
    assert house.tiles(house.survey(visited).survey_id) == []


def test_a_job_of_a_deleted_map_does_nothing(house: House, visited: JobRecord) -> None:
    house.catalog.maps.delete(MAP)
    files = house.files()
    run(visited)
    assert house.files() == files


def half_of(house: House, name: str, whole: ScanRecord) -> ScanRecord:
    with house.catalog.blobs.local(whole.key) as path:
        content = path.read_bytes()
    return house.add_file(name, content[: len(content) // 2])


@pytest.mark.parametrize("kind", ["map", "survey"])
def test_a_job_whose_only_scan_is_broken_fails_and_names_it(house: House, kind: JobKind) -> None:
    cut = half_of(house, "cut short.pcd", house.add("whole.pcd", house.material.after))
    job = house.map_of(cut, map_id="hall") if kind == "map" else house.survey_of(cut)
    with pytest.raises(ScanError):
        run(job, "register")
    assert failed(house, job, "scan_unreadable").startswith("cut short.pcd: ")
    status = house.catalog.maps.get("hall").status if kind == "map" else house.survey(job).status
    assert status == "failed"
    if kind == "survey":
        (scan,) = house.survey(job).scans
        assert (scan.accepted, scan.reason) == (False, "unreadable")
        assert scan.detail == failed(house, job, "scan_unreadable")
        assert house.survey(job).placement == Placement(state="refused", confidence=None)
    run(job)  # what still stood in the queue
    failed(house, job, "scan_unreadable")


@pytest.mark.parametrize("kind", ["map", "survey"])
def test_a_broken_scan_beside_a_whole_one_is_left_out_and_named(house: House, kind: JobKind) -> None:
    whole = house.add("whole.pcd", house.material.after)
    cut = half_of(house, "cut short.pcd", whole)
    job = house.map_of(whole, cut, map_id="hall") if kind == "map" else house.survey_of(whole, cut)
    run(job, "register")
    scans = house.catalog.maps.get("hall").scans if kind == "map" else house.survey(job).scans
    assert [scan.accepted for scan in scans] == [True, False]
    assert str(scans[1].detail).startswith("cut short.pcd: ")
    assert scans[1].reason == "unreadable"


def test_a_survey_of_another_place_fails_and_lists_each_scans_numbers(house: House) -> None:
    job = house.survey_of(house.add("foreign.pcd", house.material.foreign, pose=False))
    with pytest.raises(NoScanAccepted):
        run(job)
    assert "foreign.pcd: of the surfaces that it shares with the map " in failed(
        house, job, "registration_failed"
    )
    survey = house.survey(job)
    assert survey.status == "failed"
    (outcome,) = survey.scans
    assert outcome.accepted is False
    assert outcome.reason in REASONS
    assert "foreign.pcd" in str(outcome.detail)
    assert f"{outcome.detail} [{outcome.reason}]" in failed(house, job, "registration_failed")
    assert survey.placement == Placement(state="refused", confidence=None)
    picture = house.catalog.blobs.get_bytes(blob_keys.survey_picture(survey.survey_id))
    assert picture.startswith(b"\x89PNG")
    assert outcome.fitness is not None
    assert outcome.map_from_scan is None
    assert house.tiles(survey.survey_id) == []  # never "no change"


def test_a_foreign_scan_beside_a_good_one_is_listed_and_left_out(house: House) -> None:
    good = house.add("after.pcd", house.material.after)
    job = house.survey_of(house.add("foreign.pcd", house.material.foreign, pose=False), good)
    run(job, "register")
    survey = house.survey(job)
    assert [outcome.accepted for outcome in survey.scans] == [False, True]
    kept = [
        house.catalog.blobs.exists(blob_keys.survey_scan(survey.survey_id, outcome.scan_id))
        for outcome in survey.scans
    ]
    assert kept == [False, True]


def test_a_model_that_cuts_otherwise_than_the_map_was_is_refused(house: House) -> None:
    job = house.survey_of(house.add("after.pcd", house.material.after), model=OTHER_CUT)
    with pytest.raises(DetectorUnavailable):
        run(job)
    assert "spicd-net/3 needs voxels of 0.05 m and tiles of (2.0, 2.0, 1.0)" in failed(
        house, job, "detector_unavailable"
    )


def test_a_model_that_is_not_there_fails_the_job(house: House) -> None:
    job = house.survey_of(house.add("after.pcd", house.material.after), model="spicd-net/99")
    with pytest.raises(DetectorUnavailable):
        run(job)
    failed(house, job, "detector_unavailable")


def test_scans_too_thin_for_a_tile_make_no_map_but_are_listed(house: House) -> None:
    write_pcd(house.folder / "thin", np.random.default_rng(0).uniform(0, 5, (900, 3)).astype(np.float32))
    job = house.map_of(house.add_file("thin.pcd", (house.folder / "thin").read_bytes()), map_id="thin")
    with pytest.raises(MapFailed):
        run(job)
    assert "no tile holds 512 points" in failed(house, job, "map_failed")
    assert house.catalog.maps.get("thin").scans[0].accepted


def test_a_step_before_its_turn_is_harmless(house: House, visited: JobRecord) -> None:
    with pytest.raises(FileNotFoundError):
        run(visited, "score")
    with pytest.raises(FileNotFoundError):
        run(visited, "export")
    assert house.catalog.jobs.get(visited.job_id).status == "running"
    run(visited)
    in_turn, out_of_turn = (house.tiles(house.survey(job).survey_id) for job in (house.done[0], visited))
    assert out_of_turn == in_turn


@pytest.mark.parametrize(("encoded", "expected"), [(True, [0.0, 1.0]), (False, [0.0, 0.5, 0.5, 1.0])])
def test_scoring_never_goes_back_when_the_map_has_to_be_encoded_first(
    encoded: bool, expected: list[float]
) -> None:
    told: list[float] = []
    progress = scoring(lambda _, share: told.append(share), encoded=encoded)
    for stage in ("scoring",) if encoded else ("encoding", "scoring"):
        progress(stage, 0.0)
        progress(stage, 1.0)
    assert told == expected


def test_what_a_step_is_in_the_middle_of_lies_in_the_scratch_folder(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders: list[Path] = []

    def noting(parent: Path, name: str) -> AbstractContextManager[Path]:
        folders.append(parent)
        return scratch_folder(parent, name)

    monkeypatch.setattr("worker.jobs.step.scratch_folder", noting)
    run(house.map_of(house.add("one.pcd", house.material.before[1]), map_id="hall"))
    assert set(folders) == {Settings().scratch_dir()}
    assert list(Settings().scratch_dir().iterdir()) == []


def test_the_steps_that_the_queue_names_are_those_of_the_worker() -> None:
    assert {step.function.removeprefix("worker.jobs.") for steps in STEPS.values() for step in steps} <= set(
        jobs.__all__
    )


def test_a_build_gives_way_to_a_survey_and_goes_on_with_the_pairs_it_had(
    house: House, visited: JobRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans = [house.add(f"hall-{number}.pcd", scan) for number, scan in enumerate(house.material.before)]
    build = house.map_of(*scans, house.add("hall-2.pcd", house.material.after), map_id="hall")
    monkeypatch.setattr("worker.reporting._TURN_S", 0.0)
    monkeypatch.setattr("service.catalog.jobs._BEGINS", timedelta(0))
    run(build, "register")
    job = house.catalog.jobs.get(build.job_id)
    assert (job.status, job.step, job.attempts, job.interruptions) == ("running", "register", 0, 0)
    assert job.message == "gave way to a survey; goes on after it"
    kept = house.catalog.blobs.under(blob_keys.map_work(build.job_id))
    assert kept
    house.catalog.jobs.dismiss(visited.job_id)
    run(build)
    assert house.catalog.jobs.get(build.job_id).status == "successful"


def test_a_step_that_the_database_leaves_waits_and_is_run_again(
    house: House, visited: JobRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object, **__: object) -> None:
        raise DatabaseUnavailable("the database does not answer")

    with monkeypatch.context() as patch:
        patch.setattr("worker.jobs.surveys.locate_survey", away)
        run(visited, "register")
    job = house.catalog.jobs.get(visited.job_id)
    assert (job.status, job.attempts, job.interruptions) == ("running", 0, 1)
    assert "does not answer" in job.message
    run(visited)
    assert house.catalog.jobs.get(visited.job_id).status == "successful"


def test_a_step_goes_on_while_the_database_does_not_take_how_far_it_is(
    house: House, visited: JobRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object, **__: object) -> bool:
        raise DatabaseUnavailable("the database does not answer")

    monkeypatch.setattr(Jobs, "report", away)
    run(visited)
    job = house.catalog.jobs.get(visited.job_id)
    assert (job.status, job.interruptions) == ("successful", 0)


def test_on_a_full_disk_what_a_step_wrote_aside_is_gone_before_its_end_is_recorded(
    house: House, visited: JobRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Jobs.fail
    left: list[Path] = []

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def fail(self: Jobs, job_id: str, problem: Problem, **at: Any) -> bool:
        left.extend(Settings().scratch_dir().iterdir())
        return real(self, job_id, problem, **at)

    monkeypatch.setattr("worker.jobs.surveys.locate_survey", full)
    monkeypatch.setattr(Jobs, "fail", fail)
    with pytest.raises(NoSpaceLeft):
        run(visited, "register")
    assert left == []
    problem = house.catalog.jobs.get(visited.job_id).problem
    assert problem is not None
    assert problem.code == "disk_full"
