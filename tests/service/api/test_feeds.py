"""Changes and objects in the order of publication: `after` and its cursor."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from fastapi.testclient import TestClient

from service.api.objects import ObjectCollection
from service.api.tiles import TileCollection
from service.catalog.catalog import Catalog
from service.catalog.tables import now
from tests.support.samples import NOON, add_map, add_scan, add_survey, place, thing, tile

LOOKED = [tile(i, j, "unchanged", 0.1, observed_share=0.9) for i in range(3) for j in range(3)]


def get(client: TestClient, url: str, **asked: Any) -> dict[str, Any]:
    answer = client.get(url, params=asked or None)
    assert answer.status_code == 200, answer.text
    document: dict[str, Any] = answer.json()
    return document


def following(document: dict[str, Any]) -> str:
    return next(str(link["href"]) for link in document["links"] if link["rel"] == "next")


def test_a_poller_sees_a_late_visit_and_nothing_twice(client: TestClient, catalog: Catalog) -> None:
    """5 March is polled before the visit of 4 March is uploaded; one change stays over both."""
    add_map(catalog)
    url, seen = "/maps/lobby/changes?after=0", []
    for day, tiles in ((5, [tile(0, 0)]), (4, [tile(0, 0), tile(1, 0)]), (6, [tile(0, 0)])):
        add_survey(catalog, tiles, captured_at=NOON + timedelta(days=day))
        document = get(client, url)
        TileCollection.model_validate(document)
        seen.append([feature["properties"]["tile_id"][5:8] for feature in document["features"]])
        url = following(document)
    assert seen == [["000"], ["001"], []]
    assert get(client, url)["cursor"] == document["cursor"]


def test_pages_hold_every_change_once(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(i, 0) for i in range(5)], captured_at=NOON)
    url, seen = "/maps/lobby/changes?after=0&limit=2", []
    for _ in range(4):
        document = get(client, url)
        seen += [feature["properties"]["change_id"] for feature in document["features"]]
        url = following(document)
    assert len(seen) == len(set(seen)) == 5


def test_a_filter_moves_the_cursor_over_what_it_leaves_out(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0, score=0.6), tile(1, 0, score=0.9)], captured_at=NOON)
    document = get(client, "/maps/lobby/changes", after="0", min_score="0.8")
    assert [feature["properties"]["score"] for feature in document["features"]] == [0.9]
    again = get(client, following(document))
    assert (again["features"], again["cursor"]) == ([], document["cursor"])


def test_what_was_withdrawn_is_told_to_who_has_seen_it(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)], captured_at=NOON)
    document = get(client, "/maps/lobby/changes", after="0")
    (feature,) = document["features"]
    catalog.surveys.delete(survey_id)
    again = get(client, following(document))
    assert again["withdrawn"] == [{"id": feature["properties"]["change_id"], "merged_into": None}]
    assert get(client, "/maps/lobby/changes", after="0")["withdrawn"] == []


def test_objects_are_published_likewise(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(
        catalog, LOOKED, captured_at=NOON + timedelta(days=5), objects=[thing(1, now=place(1, 1))], moving=0
    )
    document = get(client, "/maps/lobby/objects", after="0")
    ObjectCollection.model_validate(document)
    (first,) = document["features"]
    late = [thing(1, now=place(1, 1)), thing(2, now=place(4, 1))]
    late_id, _ = add_survey(catalog, LOOKED, captured_at=NOON + timedelta(days=4), objects=late, moving=0)
    document = get(client, following(document))
    (second,) = document["features"]
    assert first["id"] != second["id"]
    catalog.surveys.delete(late_id)
    assert get(client, following(document))["withdrawn"] == [{"id": second["id"], "merged_into": None}]


def test_a_cursor_of_long_ago_is_gone(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0)], captured_at=NOON)
    add_scan(catalog, "later")
    catalog.events.sweep(now() + timedelta(seconds=1))
    answer = client.get("/maps/lobby/changes", params={"after": "2"})
    assert answer.status_code == 410
    assert answer.json()["type"] == "urn:spicd:problem:gone"
    assert len(get(client, "/maps/lobby/changes", after="0")["features"]) == 1


def test_after_is_a_cursor_of_ours_and_goes_with_no_other_order(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    for wrong in ("-1", "1.5", "x", "1-", "9" * 19, "１"):
        answer = client.get("/maps/lobby/changes", params={"after": wrong})
        assert answer.status_code == 422, wrong
        assert answer.json()["errors"][0]["place"] == "query.after"
    for other in ({"repeats": "true"}, {"cursor": "abc"}):
        assert client.get("/maps/lobby/changes", params={"after": "0", **other}).status_code == 422
