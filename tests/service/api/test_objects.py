"""/surveys/{id}/objects and /maps/{id}/objects: shape, filters, pages, and the story of a map."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.api.gis.geodesy import to_wgs84
from service.api.http.answering.paging import encoded
from service.api.objects import FgObjectCollection, FgObjectHistory, FgSightingCollection
from service.catalog.catalog import Catalog
from service.catalog.records import Anchor, ObjectRecord
from tests.support.samples import (
    NOON,
    RememberingQueue,
    add_map,
    add_survey,
    catalog_of,
    place,
    running,
    settings_in,
    thing,
    tile,
)

LOOKED = [tile(i, j, "unchanged", 0.1, observed_share=0.9) for i in range(6) for j in range(3)]
BOX, CHAIR = place(1, 1), place(4, 1)
DESK, DESK_BEFORE = place(7, 1, size=(1.6, 0.8, 0.75)), place(7, 3.4, size=(1.6, 0.8, 0.75), yaw=math.pi / 2)
BERLIN = {"longitude": 13.4, "latitude": 52.5, "height": 76.25, "heading": 90.0}


def visit(catalog: Catalog, day: int, *objects: ObjectRecord) -> str:
    """A survey of a day that looked everywhere; its id."""
    return add_survey(catalog, LOOKED, captured_at=NOON + timedelta(days=day), objects=objects, moving=1)[0]


def add_story(catalog: Catalog) -> list[str]:
    """Three visits: a desk is moved and a box brought, a chair taken, the box taken away; and a visit elsewhere."""
    add_map(catalog)
    desk = thing(2, now=DESK, before=DESK_BEFORE, probability=0.8)
    return [
        visit(catalog, 0, thing(1, now=BOX), desk),
        visit(catalog, 1, thing(1, now=BOX), desk, thing(3, before=CHAIR, probability=0.7)),
        visit(catalog, 2, desk, thing(3, before=CHAIR, probability=0.7)),
    ]


@pytest.fixture(scope="module")
def asked_often(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[TestClient, list[str]]]:
    """A service with that story, for requests that change nothing; and the ids of the visits."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        yield client, add_story(catalog_of(client))


def properties(client: TestClient, path: str = "/maps/lobby/objects", **asked: Any) -> list[dict[str, Any]]:
    answer = client.get(path, params=asked)
    assert answer.status_code == 200, answer.text
    body = answer.json()
    assert body["numberReturned"] == len(body["features"])
    return [feature["properties"] for feature in body["features"]]


def kinds(client: TestClient, **asked: Any) -> list[str]:
    return sorted(found["kind"] for found in properties(client, **asked))


ALL = ["appeared", "disappeared", "moved"]


def test_the_objects_of_a_map_tell_its_story(asked_often: tuple[TestClient, list[str]]) -> None:
    client, (first, second, third) = asked_often
    found = {one["kind"]: one for one in properties(client)}
    told = {kind: (one["status"], one["transient"], one["sightings"]) for kind, one in found.items()}
    assert told == {
        "moved": ("still_there", False, 3),
        "appeared": ("gone_again", False, 2),
        "disappeared": ("still_there", False, 2),
    }
    box = found["appeared"]
    assert (box["first_seen"], box["last_seen"]) == ("2026-03-01T12:00:00Z", "2026-03-02T12:00:00Z")
    assert (box["last_looked"], box["survey_id"]) == ("2026-03-03T12:00:00Z", second)
    for survey_id in (first, second, third):
        seen = {one["kind"]: one["object_id"] for one in properties(client, f"/surveys/{survey_id}/objects")}
        assert seen.items() <= {kind: one["object_id"] for kind, one in found.items()}.items()


def test_map_and_surveys_count_their_objects(asked_often: tuple[TestClient, list[str]]) -> None:
    client, (_, second, _) = asked_often
    survey = client.get(f"/surveys/{second}").json()
    assert survey["objects"] == {"appeared": 1, "disappeared": 1, "moved": 1}
    assert survey["moving"] == 1
    expected = {"new": 0, "still_there": 2, "gone_again": 1, "unknown": 0, "accepted": 0}
    assert client.get("/maps/lobby").json()["objects"] == expected
    assert client.get("/maps").json()["maps"][0]["objects"] == expected
    for document, href in (
        (survey, f"/surveys/{second}/objects"),
        (client.get("/maps/lobby").json(), "/maps/lobby/objects"),
    ):
        assert href in [link["href"] for link in document["links"] if link["rel"] == "objects"]


def test_an_object_is_a_prism_over_its_footprint_with_both_places(
    asked_often: tuple[TestClient, list[str]],
) -> None:
    client, (first, _, _) = asked_often
    answer = client.get(f"/surveys/{first}/objects", params={"profile": "jsonfg"})
    assert answer.headers["content-type"] == "application/vnd.ogc.fg+json"
    FgSightingCollection.model_validate_json(answer.content)
    body = answer.json()
    assert (body["featureType"], body["numberMatched"]) == ("spicd-object", 2)
    box, desk = body["features"]
    assert (box["id"], desk["id"]) == (f"{first}.object_1", f"{first}.object_2")
    assert box["place"] == {
        "type": "Prism",
        "base": {
            "type": "Polygon",
            "coordinates": [[[0.75, 0.75], [1.25, 0.75], [1.25, 1.25], [0.75, 1.25], [0.75, 0.75]]],
        },
        "lower": 0.0,
        "upper": 0.9,
    }
    assert (box["geometry"], box["time"]) == (None, {"timestamp": "2026-03-01T12:00:00Z"})
    told = desk["properties"]
    assert desk["place"]["base"]["coordinates"][0] == told["now"]["footprint"]
    assert told["before"]["center"] == [7.0, 3.4, 0.375]
    assert (told["now"]["yaw_degrees"], told["before"]["yaw_degrees"]) == (0, 90)
    assert told["motion"]["translation"] == [0.0, pytest.approx(-2.4), 0.0]
    assert told["motion"]["yaw_degrees"] == -90
    assert (box["properties"]["before"], box["properties"]["motion"]) == (None, None)


def test_an_object_over_time_has_an_interval_and_each_of_its_sightings(
    asked_often: tuple[TestClient, list[str]],
) -> None:
    client, (first, second, _) = asked_often
    answer = client.get("/maps/lobby/objects", params={"profile": "jsonfg"})
    FgObjectCollection.model_validate_json(answer.content)
    (box,) = (one for one in answer.json()["features"] if one["properties"]["kind"] == "appeared")
    assert box["id"] == box["properties"]["object_id"]
    assert box["time"] == {"interval": ["2026-03-01T12:00:00Z", "2026-03-02T12:00:00Z"]}
    answer = client.get(f"/maps/lobby/objects/{box['id']}", params={"profile": "jsonfg"})
    FgObjectHistory.model_validate_json(answer.content)
    found = answer.json()
    assert found["properties"] == box["properties"]
    assert [one["properties"]["survey_id"] for one in found["sightings"]] == [first, second]
    assert [one["properties"]["captured_at"][:10] for one in found["sightings"]] == [
        "2026-03-01",
        "2026-03-02",
    ]


def test_what_moved_stays_so_after_a_visit_that_tells_a_part_of_it(tmp_path: Path) -> None:
    """A desk is moved; then told as gone there and come here; then seen here by a visit that looked nowhere else."""
    with running(settings_in(tmp_path), RememberingQueue()) as client:
        catalog = catalog_of(client)
        add_map(catalog)
        first = visit(catalog, 0, thing(1, now=DESK, before=DESK_BEFORE))
        second = visit(catalog, 1, thing(1, before=DESK_BEFORE), thing(2, now=DESK))
        at = NOON + timedelta(days=2)
        third, _ = add_survey(catalog, LOOKED[12:13], captured_at=at, objects=[thing(1, now=DESK)])
        (listed,) = properties(client, kind="moved")
        assert properties(client, kind="appeared") == []
        found = client.get(f"/maps/lobby/objects/{listed['object_id']}").json()
    assert found["properties"] == listed
    assert (listed["sightings"], listed["survey_id"], listed["before"]["center"]) == (
        3,
        third,
        [7.0, 3.4, 0.375],
    )
    assert (listed["moved_y"], listed["moved_yaw_degrees"]) == (pytest.approx(-2.4), None)
    told = [(one["properties"]["survey_id"], one["properties"]["kind"]) for one in found["sightings"]]
    assert told == [(first, "moved"), (second, "moved"), (third, "appeared")]


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({}, ALL),
        ({"kind": "moved"}, ["moved"]),
        ({"status": "still_there"}, ["disappeared", "moved"]),
        ({"status": "new"}, []),
        ({"last_known": "gone_again"}, ["appeared"]),
        ({"transient": "false"}, ALL),
        ({"transient": "true"}, []),
        ({"bbox": "0,0,2,2"}, ["appeared"]),
        ({"bbox": "0,0,1,9,9,3"}, []),  # above all of them
        ({"bbox": "6.5,0.9,7,1"}, ["moved"]),  # where it is now
        ({"bbox": "6.5,3,7,3.5"}, []),  # where it was before
        ({"datetime": "2026-03-03T00:00:00Z/.."}, ["disappeared", "moved"]),
        ({"datetime": "../2026-03-01T18:00:00Z"}, ["appeared", "moved"]),
        ({"datetime": "2026-03-02T12:00:00Z"}, ALL),
        ({"min_probability": "0.8"}, ["appeared", "moved"]),
        ({"min_probability": "0.8", "status": "still_there"}, ["moved"]),
    ],
)
def test_a_filter_keeps_what_it_names(
    asked_often: tuple[TestClient, list[str]], asked: dict[str, str], expected: list[str]
) -> None:
    assert kinds(asked_often[0], **asked) == expected


@pytest.mark.parametrize(
    ("asked", "expected"),
    [({"kind": "appeared"}, [1]), ({"min_probability": "0.75"}, [1, 2]), ({}, [1, 2, 3])],
)
def test_the_objects_of_a_survey_are_filtered_too(
    asked_often: tuple[TestClient, list[str]], asked: dict[str, str], expected: list[int]
) -> None:
    client, (_, second, _) = asked_often
    assert [one["number"] for one in properties(client, f"/surveys/{second}/objects", **asked)] == expected


def test_the_objects_of_a_survey_are_found_by_place_and_ordered(
    asked_often: tuple[TestClient, list[str]],
) -> None:
    client, (_, second, _) = asked_often
    here = f"/surveys/{second}/objects"

    def numbers(**asked: str) -> list[int]:
        return [one["number"] for one in properties(client, here, **asked)]

    assert numbers(bbox="0,0,2,2") == [1]
    assert numbers(bbox="0,0,2,9,9,3") == []  # above all of them
    assert numbers(sortby="-number") == [3, 2, 1]
    assert numbers(sortby="probability") == [3, 2, 1]
    for sortby, expected in (("-number", [3, 2, 1]), ("-probability", [1, 2, 3])):
        url: str | None = f"{here}?limit=1&sortby={sortby}"
        seen = []
        while url:
            body = client.get(url).json()
            assert body["numberMatched"] == 3
            seen += [one["properties"]["number"] for one in body["features"]]
            url = next((one["href"] for one in body["links"] if one["rel"] == "next"), None)
        assert seen == expected


def test_the_objects_of_a_map_are_found_by_survey_and_device_and_ordered(
    asked_often: tuple[TestClient, list[str]],
) -> None:
    client, (first, _, third) = asked_often
    assert kinds(client, survey=first) == ["appeared", "moved"]
    assert kinds(client, survey=third) == ["disappeared", "moved"]
    assert kinds(client, device_id="robot-1") == []
    told = [one["kind"] for one in properties(client, sortby="probability")]
    assert told == ["disappeared", "moved", "appeared"]
    for sortby in ("first_seen", "-last_seen", "last_looked", "-probability"):
        whole = [one["object_id"] for one in properties(client, sortby=sortby)]
        url: str | None = f"/maps/lobby/objects?limit=1&sortby={sortby}"
        seen = []
        while url:
            body = client.get(url).json()
            seen += [one["id"] for one in body["features"]]
            url = next((one["href"] for one in body["links"] if one["rel"] == "next"), None)
        assert seen == whole


def test_an_object_says_in_flat_numbers_what_its_places_say(
    asked_often: tuple[TestClient, list[str]],
) -> None:
    client, (first, _, _) = asked_often
    box, desk = properties(client, f"/surveys/{first}/objects")
    for told, place_now in ((box, box["now"]), (desk, desk["now"])):
        assert [told["center_x"], told["center_y"]] == place_now["center"][:2]
        assert [told["size_x"], told["size_y"], told["size_z"]] == place_now["size"]
        assert told["z_max"] - told["z_min"] == pytest.approx(place_now["size"][2])
        assert told["yaw_degrees"] == place_now["yaw_degrees"]
        assert told["height_over_floor"] == place_now["height_over_floor"]
    assert [desk["moved_x"], desk["moved_y"], desk["moved_z"]] == desk["motion"]["translation"]
    assert desk["moved_yaw_degrees"] == -90
    assert [box[name] for name in ("moved_x", "moved_y", "moved_z", "moved_yaw_degrees")] == [None] * 4


@pytest.mark.parametrize(
    "asked", [{"status": "lost"}, {"kind": "broken"}, {"bbox": "1"}, {"limit": "0"}, {"stat": "new"}]
)
def test_a_value_that_does_not_match_is_named(
    asked_often: tuple[TestClient, list[str]], asked: dict[str, str]
) -> None:
    ((name, _),) = asked.items()
    answer = asked_often[0].get("/maps/lobby/objects", params=asked)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["place"] == f"query.{name}"


@pytest.mark.parametrize("of", ["/maps/lobby", "survey"])
def test_pages_hold_every_object_once(asked_often: tuple[TestClient, list[str]], of: str) -> None:
    client, (_, second, _) = asked_often
    path = f"/surveys/{second}/objects" if of == "survey" else f"{of}/objects"
    url: str | None = f"{path}?limit=1&min_probability=0.1"
    seen = []
    while url:
        body = client.get(url).json()
        assert (body["numberMatched"], body["numberReturned"]) == (3, 1)
        seen += [feature["properties"]["object_id"] for feature in body["features"]]
        url = next((link["href"] for link in body["links"] if link["rel"] == "next"), None)
    assert len(seen) == len(set(seen)) == 3
    for cursor in ("nonsense", encoded("x", "y", "z"), encoded("x")):
        assert client.get(path, params={"cursor": cursor}).status_code == 422


def test_what_there_is_not_is_not_found(asked_often: tuple[TestClient, list[str]]) -> None:
    client, _ = asked_often
    for path in ("/maps/attic/objects", "/surveys/none/objects", "/maps/lobby/objects/object-none"):
        assert client.get(path).status_code == 404


def test_an_object_of_another_map_is_not_found(client: TestClient, catalog: Catalog) -> None:
    add_story(catalog)
    add_map(catalog, "hall")
    object_id = properties(client)[0]["object_id"]
    assert client.get(f"/maps/lobby/objects/{object_id}").status_code == 200
    assert client.get(f"/maps/hall/objects/{object_id}").status_code == 404
    assert properties(client, "/maps/hall/objects") == []


def test_a_survey_of_a_model_of_tiles_tells_no_objects_rather_than_none(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    answer = client.get(f"/surveys/{survey_id}/objects")
    assert answer.status_code == 404
    assert f"/surveys/{survey_id}/tiles" in answer.json()["detail"]
    assert client.get(f"/surveys/{survey_id}").json()["objects"] is None
    nothing, _ = add_survey(catalog, LOOKED, captured_at=NOON + timedelta(days=1), objects=[])
    assert properties(client, f"/surveys/{nothing}/objects") == []


def test_a_survey_that_is_not_ready_has_no_objects_yet(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    catalog.surveys.save_result(survey_id, tiles=LOOKED, threshold=0.5, objects=[thing(1, now=BOX)])
    answer = client.get(f"/surveys/{survey_id}/objects")
    assert (answer.status_code, job_id in answer.json()["detail"]) == (409, True)
    assert properties(client) == []


def test_a_map_that_is_not_ready_has_no_objects_to_tell(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog, ready=False)
    assert client.get("/maps/lobby/objects").status_code == 409


def test_an_anchor_puts_footprints_on_the_earth(client: TestClient, catalog: Catalog) -> None:
    first, *_ = add_story(catalog)
    client.put("/maps/lobby/anchor", json=BERLIN)
    convert = to_wgs84(Anchor(**BERLIN))
    object_id = properties(client, kind="appeared")[0]["object_id"]
    asked = {"profile": "jsonfg"}
    alone = client.get(f"/maps/lobby/objects/{object_id}", params=asked).json()
    listed = client.get("/maps/lobby/objects", params=asked).json()["features"]
    seen = client.get(f"/surveys/{first}/objects", params=asked).json()["features"]
    for feature in (alone, *alone["sightings"], *listed, *seen):
        (ring,) = feature["geometry"]["coordinates"]
        (local,) = feature["place"]["base"]["coordinates"]
        for position, corner in zip(ring, local, strict=True):
            assert position == pytest.approx(convert((*corner, feature["place"]["lower"])), abs=1e-3)
