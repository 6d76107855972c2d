"""/surveys/{id}/tiles: filters, orders and pages; and those that changes have beside."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.api.gis.geodesy import to_wgs84
from service.catalog.catalog import Catalog
from service.catalog.records import Anchor, TileRecord
from tests.service.api.test_objects import BERLIN
from tests.support.samples import (
    MODEL,
    NOON,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    catalog_of,
    running,
    settings_in,
    tile,
)


def voxels(found: TileRecord, appeared: int, disappeared: int) -> TileRecord:
    return found.model_copy(update={"appeared": appeared, "disappeared": disappeared, "observed_share": 0.9})


TILES = [
    voxels(tile(0, 0, "changed", 0.9), 30, 0),
    voxels(tile(1, 0, "changed", 0.7), 0, 40),
    tile(2, 0, "unchanged", 0.1),
    tile(2, 1, "unchanged", 0.1),
    tile(3, 1, "inconsistent", 0.4),
    tile(4, 1, "unobserved"),
]


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[TestClient, str]]:
    """A service with a survey of those tiles, and its id."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        add_map(catalog_of(client))
        yield client, add_survey(catalog_of(client), TILES)[0]


def names(client: TestClient, path: str, **filters: Any) -> list[str]:
    answer = client.get(path, params=filters)
    assert answer.status_code == 200, answer.text
    assert answer.json()["numberMatched"] == len(answer.json()["features"])
    return [one["properties"]["tile_id"][7:12] for one in answer.json()["features"]]


ALL = ["0_000", "1_000", "2_000", "2_001", "3_001", "4_001"]


@pytest.mark.parametrize(
    ("filters", "expected"),
    [
        ({}, ALL),
        ({"state": "changed"}, ALL[:2]),
        ({"state": "unobserved"}, ALL[5:]),
        ({"kind": "appeared"}, ALL[:1]),
        ({"kind": "disappeared"}, ALL[1:2]),
        ({"min_score": 0.4}, [*ALL[:2], ALL[4]]),
        ({"bbox": "0,0,1,1"}, ALL[:1]),
        ({"bbox": "0,0,1,1", "bbox-crs": "map"}, ALL[:1]),
        ({"bbox": "5,2,0.5,9,9,0.8"}, ALL[4:]),
        ({"sortby": "-tile_index"}, ALL[::-1]),
        ({"sortby": "score"}, ["4_001", "2_000", "2_001", "3_001", "1_000", "0_000"]),
        ({"sortby": "-score"}, ["0_000", "1_000", "3_001", "2_000", "2_001", "4_001"]),
    ],
)
def test_tiles_of_a_survey_are_filtered_and_ordered(
    asked: tuple[TestClient, str], filters: dict[str, Any], expected: list[str]
) -> None:
    client, survey_id = asked
    assert names(client, f"/surveys/{survey_id}/tiles", **filters) == expected


@pytest.mark.parametrize("sortby", ["tile_index", "-tile_index", "score", "-score"])
def test_pages_in_any_order_hold_every_tile_once(asked: tuple[TestClient, str], sortby: str) -> None:
    client, survey_id = asked
    whole = names(client, f"/surveys/{survey_id}/tiles", sortby=sortby)
    url: str | None = f"/surveys/{survey_id}/tiles?limit=1&sortby={sortby}"
    seen: list[str] = []
    while url:
        body = client.get(url).json()
        assert (body["numberMatched"], body["numberReturned"]) == (6, 1)
        seen += [one["properties"]["tile_id"][7:12] for one in body["features"]]
        url = next((one["href"] for one in body["links"] if one["rel"] == "next"), None)
    assert seen == whole


def test_a_cursor_goes_on_in_its_own_order_alone(asked: tuple[TestClient, str]) -> None:
    client, survey_id = asked
    body = client.get(f"/surveys/{survey_id}/tiles?limit=1&sortby=score").json()
    href = next(one["href"] for one in body["links"] if one["rel"] == "next")
    answer = client.get(href.replace("sortby=score", "sortby=-score"))
    assert answer.status_code == 422
    assert "another order" in answer.json()["detail"]


@pytest.mark.parametrize(
    "filters", [{"state": "lost"}, {"kind": "moved"}, {"sortby": "weight"}, {"bbox-crs": "EPSG:4326"}]
)
def test_a_value_that_there_is_not_is_named(asked: tuple[TestClient, str], filters: dict[str, str]) -> None:
    client, survey_id = asked
    answer = client.get(f"/surveys/{survey_id}/tiles", params=filters)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["place"] == f"query.{next(iter(filters))}"


def test_on_an_anchored_map_a_box_is_on_the_earth_unless_it_says_otherwise(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, TILES)
    client.put("/maps/lobby/anchor", json=BERLIN)
    convert = to_wgs84(Anchor(**BERLIN))
    (west, south, _), (east, north, _) = convert((0.1, 0.1, 0)), convert((1.4, 1.4, 0))
    box = f"{west!r},{south!r},{east!r},{north!r}"
    for path in (f"/surveys/{survey_id}/tiles", "/maps/lobby/changes"):
        assert names(client, path, bbox=box) == ALL[:1]
        assert names(client, path, bbox=box, **{"bbox-crs": "CRS84"}) == ALL[:1]
        assert names(client, path, bbox="0,0,1,1", **{"bbox-crs": "map"}) == ALL[:1]
        assert names(client, path, bbox="0,0,1,1") == []  # in the Gulf of Guinea
        answer = client.get(path, params={"bbox": "0,0,300,1"})
        assert (answer.status_code, "bbox-crs=map" in answer.json()["detail"]) == (422, True)
    client.delete("/maps/lobby/anchor")
    answer = client.get("/maps/lobby/changes", params={"bbox": box, "bbox-crs": "CRS84"})
    assert answer.json()["errors"][0]["place"] == "query.bbox-crs"


def add_device_survey(catalog: Catalog, device_id: str, day: int, tiles: list[TileRecord]) -> str:
    scan = add_scan(catalog, f"{device_id}-{day}")
    survey, job = catalog.surveys.create(
        "lobby",
        scan_ids=[scan.scan_id],
        model=MODEL,
        device_id=device_id,
        captured_at=NOON + timedelta(days=day),
    )
    catalog.surveys.save_result(survey.survey_id, tiles=tiles, threshold=0.5)
    catalog.jobs.succeed(job.job_id)
    return survey.survey_id


def test_changes_are_filtered_by_device_kind_and_state(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_device_survey(catalog, "robot-1", 0, TILES[:3])
    add_device_survey(catalog, "robot-2", 1, [TILES[0], TILES[4]])  # sees the first change again
    here = "/maps/lobby/changes"
    assert names(client, here) == ALL[:2]
    assert names(client, here, device_id="robot-2") == ALL[:1]  # though robot-1 told it first
    assert names(client, here, device_id="robot-1") == ALL[:2]
    assert names(client, here, device_id="robot-1", repeats=True) == ALL[:2]
    assert names(client, here, device_id="robot-3") == []
    assert names(client, here, kind="disappeared") == ALL[1:2]
    assert names(client, here, state="inconsistent") == ALL[4:5]
    assert names(client, here, state="unchanged", device_id="robot-1") == ALL[2:3]
    told = client.get(here, params={"repeats": True}).json()["features"]
    assert [one["properties"]["device_id"] for one in told] == ["robot-2", "robot-1", "robot-1"]


@pytest.mark.parametrize(
    ("sortby", "expected"),
    [
        ("first_seen", [("0", "0"), ("1", "0"), ("2", "1")]),
        ("-first_seen", [("2", "1"), ("0", "0"), ("1", "0")]),
        ("score", [("1", "0"), ("2", "1"), ("0", "0")]),
        ("-score", [("0", "0"), ("2", "1"), ("1", "0")]),
        ("-last_seen", [("2", "1"), ("0", "0"), ("1", "0")]),
        ("-max_score", [("0", "0"), ("2", "1"), ("1", "0")]),
        ("captured_at", [("0", "0"), ("1", "0"), ("2", "1")]),
    ],
)
def test_changes_are_ordered_and_pages_follow(
    client: TestClient, catalog: Catalog, sortby: str, expected: list[tuple[str, str]]
) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0, score=0.9), tile(1, 0, score=0.6)], captured_at=NOON)
    add_survey(catalog, [tile(2, 1, score=0.8)], captured_at=NOON + timedelta(days=1))
    url: str | None = f"/maps/lobby/changes?limit=1&sortby={sortby}"
    seen = []
    while url:
        body = client.get(url).json()
        seen += [one["properties"]["tile_index"][:2] for one in body["features"]]
        url = next((one["href"] for one in body["links"] if one["rel"] == "next"), None)
    assert [(str(i), str(j)) for i, j in seen] == expected
