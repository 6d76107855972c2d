"""Maps, surveys and scans in the catalog: results that replace, and deletes that take all with them."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.catalog.records import (
    Bounds,
    ObjectRecord,
    Place,
    ScanOutcome,
    ScanRecord,
    TileRecord,
    TileState,
)
from service.errors import BadRequest, Conflict, NotFound, NotReady
from tests.support.samples import (
    IDENTITY,
    MODEL,
    NOON,
    add_map,
    add_scan,
    add_survey,
    place,
    ply,
    thing,
    tile,
)


def accepted(scan_id: str, fitness: float) -> ScanOutcome:
    return ScanOutcome(
        scan_id=scan_id, accepted=True, fitness=fitness, rmse=0.02, map_from_scan=IDENTITY, reason=None
    )


def test_a_map_lists_its_scans_in_the_order_asked_for(catalog: Catalog) -> None:
    ids = [add_scan(catalog, name).scan_id for name in ("b", "a", "c")]
    catalog.maps.create(scan_ids=ids, model=MODEL, map_id="hall")
    assert [scan.scan_id for scan in catalog.maps.get("hall").scans] == ids
    assert {scan.accepted for scan in catalog.maps.get("hall").scans} == {None}


def test_a_result_saved_twice_is_the_second_result(catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    scan_id = catalog.maps.get("lobby").scans[0].scan_id
    for fitness in (0.7, 0.9):
        catalog.versions.save_result(
            job_id,
            outcomes=[accepted(scan_id, fitness)],
            bounds=Bounds(min=(0, 0, 0), max=(fitness, 1, 1)),
            counts={"tiles": round(10 * fitness)},
        )
    found = catalog.maps.get("lobby")
    assert [scan.fitness for scan in found.scans] == [0.9]
    assert found.bounds is not None
    assert (found.bounds.max[0], found.counts) == (0.9, {"tiles": 9})
    assert found.status == "building"  # only the end of the job makes it ready


def test_outcomes_of_a_failed_map_are_kept(catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    scan_id = catalog.maps.get("lobby").scans[0].scan_id
    left_out = ScanOutcome(
        scan_id=scan_id,
        accepted=False,
        fitness=0.1,
        rmse=0.04,
        reason="ambiguous",
        detail="two poses fit alike, 0.90 and 0.89; give a pose prior",
        numbers={"margin": 0.01},
        candidates=(IDENTITY, IDENTITY),
    )
    catalog.versions.save_outcomes(job_id, [left_out])
    assert catalog.maps.get("lobby").scans == (left_out,)


def test_an_outcome_of_a_foreign_scan_is_a_mistake(catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    with pytest.raises(ValueError, match="elsewhere"):
        catalog.versions.save_outcomes(job_id, [accepted("elsewhere", 1)])


def test_an_id_is_taken_once_and_the_second_leaves_no_job(catalog: Catalog) -> None:
    add_map(catalog)
    scan = add_scan(catalog, "other")
    with pytest.raises(Conflict, match="lobby"):
        catalog.maps.create(scan_ids=[scan.scan_id], model=MODEL, map_id="lobby")
    assert len(catalog.jobs.page().items) == 1


def test_unknown_scans_are_named_all(catalog: Catalog) -> None:
    with pytest.raises(NotFound, match="'x', 'y'"):
        catalog.maps.create(scan_ids=["x", add_scan(catalog).scan_id, "y"], model=MODEL)
    assert catalog.maps.page().items == []


@pytest.mark.parametrize("scan_ids", [[], ["twice", "twice"]])
def test_a_map_needs_scans_each_once(catalog: Catalog, scan_ids: list[str]) -> None:
    with pytest.raises(BadRequest):
        catalog.maps.create(scan_ids=scan_ids, model=MODEL)


def test_a_survey_saved_twice_has_its_tiles_once_and_counts_them(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, ready=False)
    catalog.surveys.save_result(survey_id, tiles=[tile(i, 0) for i in range(5)], threshold=0.4)
    catalog.surveys.save_result(
        survey_id,
        tiles=[tile(0, 0), tile(1, 0, "unchanged", 0.1), tile(2, 0, "unobserved")],
        threshold=0.5,
    )
    assert [change.tile.tile_index[0] for change in catalog.changes.of_survey(survey_id)] == [0, 1, 2]
    found = catalog.surveys.get(survey_id)
    assert found.threshold == 0.5
    assert found.counts == {
        "tiles": 3,
        "changed": 1,
        "unchanged": 1,
        "inconsistent": 0,
        "unobserved": 1,
    }


def test_a_survey_counts_its_objects_by_kind_and_what_moved_meanwhile(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, ready=False)
    assert (catalog.surveys.get(survey_id).objects, catalog.surveys.get(survey_id).moving) == (None, None)
    tiles = [tile(0, 0, observed_share=0.9)]
    objects = [
        thing(1, now=place(1, 1)),
        thing(2, now=place(4, 1), before=place(1, 4)),
        thing(3, now=place(9, 9)),
    ]
    catalog.surveys.save_result(survey_id, tiles=tiles, threshold=0.5, objects=objects, moving=2)
    found = catalog.surveys.get(survey_id)
    assert found.objects == {"appeared": 2, "disappeared": 0, "moved": 1}
    assert found.moving == 2
    catalog.surveys.save_result(survey_id, tiles=tiles, threshold=0.5, objects=[], moving=0)
    found = catalog.surveys.get(survey_id)
    assert (found.objects, found.moving) == ({"appeared": 0, "disappeared": 0, "moved": 0}, 0)


@pytest.mark.parametrize("objects", [None, []])
def test_a_survey_of_a_detector_of_tiles_tells_no_objects_rather_than_none_found(
    catalog: Catalog, objects: Any
) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)], objects=objects)
    assert catalog.surveys.get(survey_id).objects is None


def test_objects_of_one_survey_have_a_number_each(catalog: Catalog) -> None:
    add_map(catalog)
    with pytest.raises(ValueError, match=r"\[1, 1\]"):
        add_survey(catalog, objects=[thing(1, now=place(1, 1)), thing(1, now=place(4, 1))])


def test_what_a_survey_says_of_its_tiles_is_kept(catalog: Catalog) -> None:
    add_map(catalog)
    told = tile(0, 0).model_copy(update={"observed_share": 0.75, "appeared": 41, "disappeared": 7})
    survey_id, _ = add_survey(catalog, [told])
    assert [change.tile for change in catalog.changes.of_survey(survey_id)] == [told]


@pytest.mark.parametrize(
    "ring", [((0, 0), (2, 0), (2, 1)), ((0, 0), (2, 1), (2, 0)), ((0, 0), (2, 0), (2, 1), (0, 0))]
)
def test_an_outline_is_kept_open_and_counter_clockwise(ring: Any) -> None:
    kept = Place.model_validate({**place(1, 1).model_dump(), "footprint": ring}).footprint
    doubled = (*kept, *kept)
    assert ((0, 0), (2, 0), (2, 1)) in {doubled[start : start + 3] for start in range(3)}


def test_an_object_has_the_places_of_its_kind() -> None:
    moved = thing(1, now=place(1, 1), before=place(4, 1)).model_dump()
    for wrong in ({"now": None}, {"before": None}, {"motion": None}, {"kind": "appeared"}):
        with pytest.raises(ValidationError, match="does not go with"):
            ObjectRecord.model_validate(moved | wrong)


def test_a_survey_is_as_late_as_its_latest_scan(catalog: Catalog) -> None:
    add_map(catalog)
    ids = [
        add_scan(catalog, str(hour), captured_at=NOON + timedelta(hours=hour)).scan_id for hour in (2, 5, 3)
    ]
    survey, _ = catalog.surveys.create("lobby", scan_ids=ids, model=MODEL)
    assert catalog.surveys.get(survey.survey_id).captured_at == NOON + timedelta(hours=5)


@pytest.mark.parametrize("ended", [False, True])
def test_a_survey_needs_a_map_that_is_ready(catalog: Catalog, ended: Any) -> None:
    job_id = add_map(catalog, ready=False)
    if ended:
        catalog.jobs.dismiss(job_id)
    with pytest.raises(NotReady, match=job_id):
        catalog.surveys.create("lobby", scan_ids=[add_scan(catalog).scan_id], model=MODEL)


def test_a_scan_deleted_while_the_same_bytes_come_again_leaves_the_new_file(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = add_scan(catalog)
    forget = catalog.blobs.delete_prefix
    again: list[ScanRecord] = []

    def late(prefix: str) -> None:
        """The row is gone and the file is not yet: now the same upload comes."""
        if not again:
            again.append(add_scan(catalog))
        forget(prefix)

    monkeypatch.setattr(catalog.blobs, "delete_prefix", late)
    catalog.scans.delete(first.scan_id)
    assert again[0].scan_id == first.scan_id
    assert catalog.blobs.get_bytes(again[0].key) == ply("hall")
    assert not catalog.blobs.exists(first.key)


def test_of_two_uploads_of_the_same_bytes_at_once_one_file_is_kept(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = catalog.blobs.put_file
    first: list[ScanRecord | None] = []

    def late(key: str, path: Path, *, move: bool) -> None:
        if not first:
            first.append(None)
            first[0] = add_scan(catalog)
            path.write_bytes(ply("hall"))
        put(key, path, move=move)

    monkeypatch.setattr(catalog.blobs, "put_file", late)
    kept = add_scan(catalog)
    assert kept == first[0]
    root = catalog.blobs._root
    assert root is not None
    assert [path for path in (root / "scans").rglob("*") if path.is_file()] == [root / kept.key]


def test_a_deleted_map_takes_its_surveys_jobs_and_blobs_and_leaves_its_scans(catalog: Catalog) -> None:
    built_by = add_map(catalog)
    add_map(catalog, "hall")
    survey_id, job_id = add_survey(catalog, [tile(0, 0)])
    catalog.blobs.put_bytes(blob_keys.map_cloud(built_by), b"ply")
    catalog.blobs.put_bytes(blob_keys.survey_cloud(survey_id), b"ply")
    catalog.maps.delete("lobby")
    for ask, key in (
        (catalog.maps.get, "lobby"),
        (catalog.surveys.get, survey_id),
        (catalog.jobs.get, job_id),
    ):
        with pytest.raises(NotFound):
            ask(key)
    assert catalog.changes.of_survey(survey_id) == ()
    assert not catalog.blobs.exists(blob_keys.map_cloud(built_by))
    assert not catalog.blobs.exists(blob_keys.survey_cloud(survey_id))
    assert len(catalog.scans.page().items) == 3
    assert [found.map_id for found in catalog.maps.page().items] == ["hall"]


def test_a_late_step_of_a_deleted_map_touches_nothing_of_the_map_that_took_its_id(catalog: Catalog) -> None:
    old = add_map(catalog, ready=False)
    catalog.maps.delete("lobby")
    new = add_map(catalog)
    before = catalog.maps.get("lobby")
    assert blob_keys.map_folder(old) != blob_keys.map_folder(new)
    left_out = [ScanOutcome(scan_id=before.scans[0].scan_id, accepted=False, reason="no_fit")]
    with pytest.raises(NotFound):
        catalog.versions.save_outcomes(old, left_out)
    with pytest.raises(NotFound):
        catalog.versions.save_result(
            old, outcomes=left_out, bounds=Bounds(min=(0, 0, 0), max=(9, 9, 9)), counts={}
        )
    assert not catalog.jobs.succeed(old)
    assert catalog.maps.get("lobby") == before


def test_the_same_bytes_from_the_same_device_are_one_scan(catalog: Catalog) -> None:
    first = add_scan(catalog, "hall", device_id="robot-1")
    assert add_scan(catalog, "hall", device_id="robot-1") == first
    assert add_scan(catalog, "hall", device_id="robot-2").scan_id != first.scan_id
    assert add_scan(catalog, "hall").scan_id != first.scan_id


def test_a_scan_in_use_stays(catalog: Catalog) -> None:
    add_map(catalog)
    scan_id = catalog.maps.get("lobby").scans[0].scan_id
    with pytest.raises(Conflict):
        catalog.scans.delete(scan_id)
    catalog.maps.delete("lobby")
    key = catalog.scans.get(scan_id).key
    catalog.scans.delete(scan_id)
    assert not catalog.blobs.exists(key)


@pytest.mark.parametrize(
    ("state", "score"), [("changed", None), ("unobserved", 0.4), ("changed", float("nan"))]
)
def test_a_tile_has_a_finite_score_exactly_where_it_was_observed(
    state: TileState, score: float | None
) -> None:
    with pytest.raises(ValidationError):
        TileRecord(
            tile_id="tile_000_000_000",
            tile_index=(0, 0, 0),
            bounds=Bounds(min=(0, 0, 0), max=(1, 1, 1)),
            state=state,
            score=score,
            probabilities=None if score is None else (0.5, 0.4, 0.1),
            n_reference=600,
            n_current=600,
        )
