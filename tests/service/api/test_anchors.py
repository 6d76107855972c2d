"""Where a map lies on the Earth, and features in WGS 84."""

from __future__ import annotations

import itertools
import json
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.api.gis.geodesy import to_wgs84
from service.catalog.catalog import Catalog
from service.catalog.records import Anchor
from tests.support.samples import add_map, add_scan, add_survey, ply, tile

BERLIN = {"longitude": 13.4, "latitude": 52.5, "height": 76.25, "heading": 90.0}


@pytest.fixture
def survey_id(catalog: Catalog) -> str:
    add_map(catalog)
    return add_survey(catalog, [tile(1, 2)])[0]


def feature(client: TestClient, survey_id: str) -> dict[str, Any]:
    found: dict[str, Any]
    asked = {"profile": "jsonfg"}
    (found,) = client.get(f"/surveys/{survey_id}/tiles", params=asked).json()["features"]
    (changed,) = client.get("/maps/lobby/changes", params=asked).json()["features"]
    assert changed["id"] == changed["properties"]["change_id"]
    assert found == {**changed, "id": found["id"]}  # the same tile, by its own id
    return found


def test_without_an_anchor_a_feature_lies_nowhere_on_earth(client: TestClient, survey_id: str) -> None:
    assert feature(client, survey_id)["geometry"] is None
    assert client.get("/maps/lobby").json()["anchor"] is None


def test_an_anchor_gives_every_feature_its_footprint_in_wgs_84(client: TestClient, survey_id: str) -> None:
    before = feature(client, survey_id)
    answer = client.put("/maps/lobby/anchor", json=BERLIN)
    assert answer.status_code == 200
    assert answer.json()["anchor"] == client.get("/maps/lobby").json()["anchor"] == BERLIN
    after = feature(client, survey_id)
    assert {**after, "geometry": None} == before  # the place in the frame of the map stays
    assert after["geometry"]["type"] == "Polygon"
    (ring,) = after["geometry"]["coordinates"]
    convert = to_wgs84(Anchor(**BERLIN))
    assert len(ring) == 5
    for position, corner in zip(ring, after["place"]["base"]["coordinates"][0], strict=True):
        expected = convert((*corner, after["place"]["lower"]))
        assert position[:2] == pytest.approx(expected[:2], abs=1e-9)  # 0.1 mm
        assert position[2] == pytest.approx(expected[2], abs=1e-3)


@pytest.mark.parametrize("heading", [0.0, 33.0, 90.0, 200.0])
def test_the_ring_is_closed_and_counter_clockwise_however_the_map_is_turned(
    client: TestClient, survey_id: str, heading: float
) -> None:
    client.put("/maps/lobby/anchor", json={**BERLIN, "heading": heading})
    (ring,) = feature(client, survey_id)["geometry"]["coordinates"]
    area = sum(a[0] * b[1] - b[0] * a[1] for a, b in itertools.pairwise(ring))
    assert ring[0] == ring[-1]
    assert area > 0


def test_an_anchor_that_is_taken_away_leaves_no_geometry(client: TestClient, survey_id: str) -> None:
    client.put("/maps/lobby/anchor", json=BERLIN)
    for _ in range(2):
        assert client.delete("/maps/lobby/anchor").status_code == 204
    assert feature(client, survey_id)["geometry"] is None
    assert client.get("/maps/lobby").json()["anchor"] is None


@pytest.mark.parametrize("as_form", [False, True])
def test_a_map_may_be_made_with_its_anchor(client: TestClient, catalog: Catalog, as_form: bool) -> None:
    if as_form:
        files = {"scans": ("a.ply", ply())}
        answer = client.post("/maps", data={"id": "hall", "anchor": json.dumps(BERLIN)}, files=files)
    else:
        asked = {"id": "hall", "scan_ids": [add_scan(catalog).scan_id], "anchor": BERLIN}
        answer = client.post("/maps", json=asked)
    assert answer.status_code == 202
    assert client.get("/maps/hall").json()["anchor"] == BERLIN


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("longitude", 180.1),
        ("latitude", -90.1),
        ("height", 10_001),
        ("heading", 360),
        ("heading", -1),
        ("heading", None),
    ],
)
def test_a_value_off_the_earth_is_named(client: TestClient, survey_id: str, name: str, value: object) -> None:
    answer = client.put("/maps/lobby/anchor", json={**BERLIN, name: value})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["place"] == f"body.{name}"
    assert client.get("/maps/lobby").json()["anchor"] is None


def test_an_anchor_is_whole_or_not_at_all(client: TestClient, survey_id: str) -> None:
    answer = client.put("/maps/lobby/anchor", json={"longitude": 13.4, "latitude": 52.5})
    assert [error["place"] for error in answer.json()["errors"]] == ["body.height", "body.heading"]


def test_a_map_that_is_not_there_has_no_anchor(client: TestClient) -> None:
    assert client.put("/maps/attic/anchor", json=BERLIN).status_code == 404
    assert client.delete("/maps/attic/anchor").status_code == 404
