"""/maps/{id}/changes: filters, order and pages."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from service.api.http.answering.paging import encoded
from service.api.tiles import TileCollection
from service.catalog.catalog import Catalog
from service.catalog.records import Problem, TileState
from tests.support.samples import (
    NOON,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    catalog_of,
    place,
    running,
    settings_in,
    thing,
    tile,
)

Visited = tuple[TestClient, dict[str, str]]  #: a service, and the ids of the visits by month
MARCH, APRIL, MAY, JUNE = (NOON + timedelta(days=days) for days in (0, 31, 61, 91))


def add_visits(catalog: Catalog) -> dict[str, str]:
    """Three visits: March and April with changes, May without; and a map beside them."""
    add_map(catalog)
    add_map(catalog, "hall")
    add_survey(catalog, [tile(0, 0, "changed", 0.99)], map_id="hall", captured_at=MAY)
    march, _ = add_survey(
        catalog, [tile(0, 0, "changed", 0.6), tile(1, 1, "changed", 0.9)], captured_at=MARCH
    )
    april, _ = add_survey(
        catalog,
        [
            tile(0, 0, "unchanged", 0.1),
            tile(2, 0, "changed", 0.7),
            tile(3, 3, "unobserved"),
            tile(2, 1, "inconsistent", 0.2),
        ],
        captured_at=APRIL,
    )
    add_survey(catalog, [tile(0, 0, "unchanged", 0.2)], captured_at=MAY)
    return {"march": march, "april": april}


@pytest.fixture
def surveys(catalog: Catalog) -> dict[str, str]:
    return add_visits(catalog)


@pytest.fixture(scope="module")
def asked_often(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visited]:
    """A service with those visits, for requests that change nothing; and the ids of the visits."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        yield client, add_visits(catalog_of(client))


def found(client: TestClient, **asked: str) -> list[tuple[str, float]]:
    answer = client.get("/maps/lobby/changes", params=asked)
    assert answer.status_code == 200, answer.text
    TileCollection.model_validate_json(answer.content)  # the answer is what the schema says
    body = answer.json()
    assert body["numberReturned"] == len(body["features"])
    return [(f["properties"]["tile_id"][5:12], f["properties"]["score"]) for f in body["features"]]


ALL = [("002_000", 0.7), ("001_001", 0.9), ("000_000", 0.6)]


def test_changed_tiles_come_newest_visit_first_then_most_certain_first(
    client: TestClient, surveys: dict[str, str]
) -> None:
    assert found(client) == ALL


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({"min_score": 0.7}, ALL[:2]),
        ({"bbox": "0,0,1.4,1.4"}, ALL[2:]),
        ({"bbox": "1.5,1.5,1.5,1.5"}, ALL[1:]),  # a corner that two boxes share
        ({"bbox": "0,0,0.2,9,9,0.3"}, ALL),
        ({"bbox": "0,0,2,9,9,3"}, []),  # above every tile
        ({"datetime": "2026-03-01T12:00:00Z"}, ALL[1:]),
        ({"datetime": "2026-03-01T13:00:00+01:00"}, ALL[1:]),
        ({"datetime": "2026-03-02T00:00:00Z/.."}, ALL[:1]),
        ({"datetime": "../2026-03-02T00:00:00Z"}, ALL[1:]),
        ({"datetime": "/2026-03-02T00:00:00Z"}, ALL[1:]),
        ({"datetime": "2026-02-01T00:00:00Z/2026-02-02T00:00:00Z"}, []),
        ({"survey": "april"}, ALL[:1]),
        ({"survey": "march", "min_score": 0.7}, ALL[1:2]),
    ],
)
def test_a_filter_keeps_what_it_names(asked_often: Visited, asked: dict[str, str], expected: Any) -> None:
    client, surveys = asked_often
    if "survey" in asked:
        asked = {**asked, "survey": surveys[asked["survey"]]}
    assert found(client, **asked) == expected


@pytest.mark.parametrize(
    "asked",
    [
        {"bbox": "0,0,1"},
        {"bbox": "0,0,nan,1"},
        {"bbox": "2,0,1,1"},
        {"datetime": "2026-03-01"},
        {"datetime": "../.."},
        {"datetime": "2026-03-02T00:00:00Z/2026-03-01T00:00:00Z"},
        {"datetime": "a/b/c"},
        {"min_score": "1.2"},
        {"limit": "0"},
        {"limit": "10001"},
        {"treshold": "0.5"},
    ],
)
def test_a_value_that_does_not_match_is_named(asked_often: Visited, asked: dict[str, str]) -> None:
    client, _ = asked_often
    ((name, value),) = asked.items()
    answer = client.get("/maps/lobby/changes", params=asked)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["place"] == f"query.{name}"
    assert answer.json()["errors"][0]["value"] == value


def test_a_foreign_cursor_is_refused(client: TestClient, surveys: dict[str, str]) -> None:
    for cursor in ("nonsense", "e30", "W10", encoded("2026-03-01T12:00:00", "a", "0x1p-1", "b")):
        answer = client.get("/maps/lobby/changes", params={"cursor": cursor})
        assert answer.status_code == 422
        assert answer.json()["type"] == "urn:spicd:problem:bad_request"


def test_pages_hold_every_change_once_while_new_ones_arrive(
    client: TestClient, catalog: Catalog, surveys: dict[str, str]
) -> None:
    tied = [tile(i, 5, "changed", 0.8) for i in range(7)]
    add_survey(catalog, tied, captured_at=MAY + timedelta(days=1))
    url: str | None = "/maps/lobby/changes?limit=3&min_score=0.5"
    seen: list[str] = []
    sizes: list[int] = []
    while url:
        body = client.get(url).json()
        assert body["numberMatched"] == (10 if len(sizes) == 0 else 11)
        seen += [feature["id"] for feature in body["features"]]
        sizes.append(body["numberReturned"])
        url = next((link["href"] for link in body["links"] if link["rel"] == "next"), None)
        if len(sizes) == 1:  # a visit that is newer than where we stand is not slipped in
            add_survey(catalog, [tile(9, 9)], captured_at=MAY + timedelta(days=2))
    assert sizes == [3, 3, 3, 1]
    assert len(set(seen)) == len(seen) == 10


def add_stay(catalog: Catalog) -> list[str]:
    """A tile that is changed in March and April, as it was in May, and changed again in June; ids of the visits."""
    add_map(catalog)
    states: list[tuple[TileState, float]] = [
        ("changed", 0.6),
        ("changed", 0.9),
        ("unchanged", 0.1),
        ("changed", 0.7),
    ]
    return [
        add_survey(catalog, [tile(0, 0, *state)], captured_at=month)[0]
        for state, month in zip(states, (MARCH, APRIL, MAY, JUNE), strict=True)
    ]


def told(client: TestClient, **asked: str) -> list[tuple[str, str, str, float]]:
    """Survey, days of first and last sight, largest score of each feature."""
    features = client.get("/maps/lobby/changes", params=asked).json()["features"]
    return [
        (p["survey_id"], p["first_seen"][5:10], p["last_seen"][5:10], p["max_score"])
        for p in (feature["properties"] for feature in features)
    ]


def test_a_change_that_stays_is_told_once_and_again_when_it_returns(
    client: TestClient, catalog: Catalog
) -> None:
    march, april, _, june = add_stay(catalog)
    again, stayed = (june, "05-31", "05-31", 0.7), (march, "03-01", "04-01", 0.9)
    assert told(client) == [again, stayed]
    assert told(client, repeats="true") == [again, (april, *stayed[1:]), stayed]
    assert told(client, survey=april) == [(april, *stayed[1:])]  # though March told it first


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({"datetime": "2026-03-15T00:00:00Z/2026-04-15T00:00:00Z"}, []),  # it was there before
        ({"datetime": "2026-03-15T00:00:00Z/2026-04-15T00:00:00Z", "repeats": "true"}, [0.9]),
        ({"datetime": "../2026-04-15T00:00:00Z"}, [0.6]),
        ({"min_score": "0.8"}, [0.6]),  # the April visit was that sure
        ({"min_score": "0.8", "repeats": "true"}, [0.9]),
    ],
)
def test_a_change_is_asked_for_by_when_it_was_first_seen_and_by_its_surest_visit(
    client: TestClient, catalog: Catalog, asked: dict[str, str], expected: list[float]
) -> None:
    add_stay(catalog)
    assert [score for _, score in found(client, **asked)] == expected


def test_a_visit_that_comes_late_makes_a_change_older_and_no_second_one(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    april, _ = add_survey(catalog, [tile(0, 0, "changed", 0.9)], captured_at=APRIL)
    before = client.get("/maps/lobby/changes").json()["features"]
    add_survey(catalog, [tile(0, 0, "changed", 0.6)], captured_at=MARCH)
    after = client.get("/maps/lobby/changes").json()["features"]
    assert [feature["id"] for feature in after] == [feature["id"] for feature in before]
    assert told(client) == [(april, "03-01", "04-01", 0.9)]
    assert told(client, datetime="2026-03-01T12:00:00Z") == told(client)


def test_a_change_whose_first_visit_is_deleted_is_told_by_the_next(
    client: TestClient, catalog: Catalog
) -> None:
    march, april, may, june = add_stay(catalog)
    catalog.surveys.delete(march)
    assert told(client) == [(june, "05-31", "05-31", 0.7), (april, "04-01", "04-01", 0.9)]
    catalog.surveys.delete(may)
    assert told(client) == [(april, "04-01", "05-31", 0.9)]


def test_pages_of_changes_that_are_told_once_go_by_when_they_were_first_seen(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(i, 0) for i in range(3)], captured_at=APRIL)
    add_survey(catalog, [tile(i, 0) for i in (1, 2, 3)], captured_at=MARCH)  # late: two of them are older
    add_survey(catalog, [tile(i, 0) for i in range(4)], captured_at=MAY)
    url: str | None = "/maps/lobby/changes?limit=1"
    seen = []
    while url:
        body = client.get(url).json()
        assert (body["numberMatched"], body["numberReturned"]) == (4, 1)
        seen += [feature["properties"] for feature in body["features"]]
        url = next((link["href"] for link in body["links"] if link["rel"] == "next"), None)
    assert [(p["tile_id"][5:8], p["first_seen"][5:10]) for p in seen] in (
        [("000", "04-01"), ("001", "03-01"), ("002", "03-01"), ("003", "03-01")],
        [("000", "04-01"), ("003", "03-01"), ("001", "03-01"), ("002", "03-01")],
    )


def test_only_a_survey_that_is_done_and_of_this_map_can_be_named(
    client: TestClient, catalog: Catalog, surveys: dict[str, str]
) -> None:
    running, job_id = add_survey(catalog, ready=False, captured_at=MAY + timedelta(days=3))
    hall = client.get("/maps/hall/surveys").json()["surveys"][0]["survey_id"]
    assert client.get("/maps/lobby/changes", params={"survey": running}).status_code == 409
    assert client.get("/maps/lobby/changes", params={"survey": hall}).status_code == 404
    assert client.get("/maps/lobby/changes", params={"survey": "none"}).status_code == 404
    catalog.surveys.save_result(running, tiles=[tile(7, 7)], threshold=0.5)
    catalog.jobs.dismiss(job_id)
    assert found(client) == ALL  # tiles of a survey that was dismissed are not changes


def test_a_map_that_is_not_ready_has_no_changes_to_tell(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog, ready=False)
    assert client.get("/maps/lobby/changes").status_code == 409


def test_what_failed_is_told_apart_from_what_is_not_ready_yet(client: TestClient, catalog: Catalog) -> None:
    """Who waits for a survey asks again while it runs, and need not for ever."""
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    building = add_map(catalog, "hall", ready=False)
    paths = (
        f"/surveys/{survey_id}/tiles",
        f"/surveys/{survey_id}/objects",
        f"/maps/lobby/changes?survey={survey_id}",
        "/maps/hall/changes",
    )
    for problem in ("not_ready", "failed"):
        for path in paths:
            answer = client.get(path)
            assert (answer.status_code, answer.json()["type"]) == (409, f"urn:spicd:problem:{problem}"), path
            assert "Retry-After" not in answer.headers
        for job in (job_id, building):
            catalog.jobs.fail(job, Problem(code="registration_failed", detail="no scan"))


def test_a_cursor_goes_on_with_the_filters_that_it_came_with_and_no_others(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    objects = [thing(1, now=place(1, 1)), thing(2, now=place(4, 1))]
    tiles = [tile(i, 0, score=0.9) for i in range(3)]
    survey_id, _ = add_survey(catalog, tiles, captured_at=MARCH, objects=objects, moving=0)
    for path, asked in (
        ("/maps/lobby/changes", {"min_score": "0.5"}),
        ("/maps/lobby/changes", {"repeats": "true"}),
        ("/maps/lobby/objects", {"kind": "appeared"}),
        (f"/surveys/{survey_id}/objects", {"min_probability": "0.1"}),
        (f"/surveys/{survey_id}/tiles", {"state": "changed"}),
        ("/jobs", {"map_id": "lobby"}),
    ):
        body = client.get(path, params={**asked, "limit": "1"}).json()
        (onwards,) = [link["href"] for link in body["links"] if link["rel"] == "next"]
        assert client.get(onwards).status_code == 200
        cursor = httpx.URL(onwards).params["cursor"]
        answer = client.get(path, params={"cursor": cursor, "limit": "1"})
        assert (answer.status_code, answer.json()["type"]) == (422, "urn:spicd:problem:bad_request"), path
        assert "the same parameters as before" in answer.json()["detail"]
        assert client.get(path, params={**asked, "cursor": cursor, "limit": "7"}).status_code == 200


def test_lists_go_on_page_by_page(client: TestClient, catalog: Catalog) -> None:
    for number in range(5):
        add_map(catalog, f"m{number}")
        add_survey(catalog, map_id="m0", captured_at=NOON + timedelta(days=number))
    add_scan(catalog, "last")
    for path, name, key, total in (
        ("/maps", "maps", "map_id", 5),
        ("/jobs", "jobs", "jobID", 10),
        ("/scans", "scans", "scan_id", 11),
        ("/maps/m0/surveys", "surveys", "survey_id", 5),
    ):
        url: str | None = f"{path}?limit=2"
        seen = []
        while url:
            body = client.get(url).json()
            assert len(body[name]) <= 2
            seen += [item[key] for item in body[name]]
            url = next((link["href"] for link in body["links"] if link["rel"] == "next"), None)
        assert len(seen) == len(set(seen)) == total
    assert [found["map_id"] for found in client.get("/maps").json()["maps"]] == ["m4", "m3", "m2", "m1", "m0"]
