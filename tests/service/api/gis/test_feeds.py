"""Changes and objects in the order of publication: `after` and its cursor."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from fastapi.testclient import TestClient

from service.api.objects import ObjectCollection
from service.api.tiles import TileCollection
from service.catalog.catalog import Catalog
from service.catalog.sql.tables import now
from tests.support.samples import NOON, add_map, add_scan, add_survey, place, thing, tile

LOOKED = [tile(i, j, "unchanged", 0.1, observed_share=0.9) for i in range(3) for j in range(3)]


def get(client: TestClient, url: str, **asked: Any) -> dict[str, Any]:
    answer = client.get(url, params=asked or None)
    assert answer.status_code == 200, answer.text
    document: dict[str, Any] = answer.json()
    return document


def following(document: dict[str, Any], rel: str = "monitor") -> str:
    """Where to go on: `next` while there is more, and at the end `monitor`."""
    (onwards,) = [link for link in document["links"] if link["rel"] in ("next", "monitor")]
    assert onwards["rel"] == rel
    return str(onwards["href"])


def told(document: dict[str, Any]) -> list[tuple[str, bool]]:
    """Id of each feature, and whether it is told anew."""
    return [(feature["id"], feature["properties"]["updated"]) for feature in document["features"]]


def test_a_poller_sees_a_late_visit_and_nothing_twice(client: TestClient, catalog: Catalog) -> None:
    """5 March is polled before the visit of 4 March is uploaded; one change stays over both."""
    add_map(catalog)
    url, seen = "/maps/lobby/changes?after=0", []
    for day, tiles in ((5, [tile(0, 0)]), (4, [tile(0, 0), tile(1, 0)]), (6, [tile(0, 0)])):
        add_survey(catalog, tiles, captured_at=NOON + timedelta(days=day))
        document = get(client, url)
        TileCollection.model_validate(document)
        shown = [feature["properties"] for feature in document["features"]]
        seen.append([(one["tile_id"][5:8], one["updated"]) for one in shown])
        url = following(document)
    assert seen == [[("000", False)], [("000", True), ("001", False)], [("000", True)]]
    assert get(client, url)["cursor"] == document["cursor"]


def test_pages_hold_every_change_once(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(i, 0) for i in range(5)], captured_at=NOON)
    url, seen = "/maps/lobby/changes?after=0&limit=2", []
    for rel in ("next", "next", "monitor", "monitor"):
        document = get(client, url)
        seen += [feature["properties"]["change_id"] for feature in document["features"]]
        url = following(document, rel)
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
    assert feature["id"] == feature["properties"]["change_id"]
    assert again["withdrawn"] == [{"id": feature["id"], "merged_into": None, "filtered": False}]
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
    again, second = document["features"]
    assert told(document) == [(first["id"], True), (second["id"], False)]
    assert (first["properties"]["status"], again["properties"]["status"]) == ("new", "still_there")
    assert again["properties"]["first_seen"] < first["properties"]["first_seen"]
    catalog.surveys.delete(late_id)
    document = get(client, following(document))
    assert document["withdrawn"] == [{"id": second["id"], "merged_into": None, "filtered": False}]
    assert told(document) == [(first["id"], True)]


def test_a_change_that_comes_to_pass_a_filter_is_told_and_one_that_leaves_it_withdrawn(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0, score=0.6), tile(1, 0, score=0.6)], captured_at=NOON)
    document = get(client, "/maps/lobby/changes", after="0", min_score="0.9")
    assert document["features"] == []
    surer, _ = add_survey(
        catalog, [tile(0, 0, score=0.95), tile(1, 0, score=0.7)], captured_at=NOON + timedelta(days=1)
    )
    document = get(client, following(document))
    ((change_id, updated),) = told(document)
    other = {one["id"] for one in get(client, "/maps/lobby/changes")["features"]} - {change_id}
    assert (updated, document["features"][0]["properties"]["max_score"]) == (True, 0.95)
    assert [(one["id"], one["filtered"]) for one in document["withdrawn"]] == [(other.pop(), True)]
    catalog.surveys.delete(surer)
    document = get(client, following(document))
    assert document["features"] == []
    assert (change_id, True) in [(one["id"], one["filtered"]) for one in document["withdrawn"]]


def test_what_became_of_an_object_is_told_to_who_follows_one_status(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    objects = [thing(1, now=place(1, 1))]
    add_survey(catalog, LOOKED, captured_at=NOON, objects=objects, moving=0)
    new = get(client, "/maps/lobby/objects", after="0", status="new")
    gone = get(client, "/maps/lobby/objects", after="0", status="gone_again")
    ((object_id, _),) = told(new)
    add_survey(catalog, LOOKED, captured_at=NOON + timedelta(days=1), objects=[], moving=0)
    new, gone = get(client, following(new)), get(client, following(gone))
    assert (told(gone), new["features"]) == ([(object_id, True)], [])
    assert new["withdrawn"] == [{"id": object_id, "merged_into": None, "filtered": True}]


def test_what_was_told_anew_or_withdrawn_comes_in_pages_too(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    only, _ = add_survey(
        catalog, [tile(i, 0, score=0.9 - i / 100) for i in range(7)], captured_at=NOON + timedelta(days=1)
    )
    document = get(client, "/maps/lobby/changes", after="0")
    ids = [change_id for change_id, _ in told(document)]
    add_survey(catalog, [tile(i, 0, score=0.5) for i in range(5)], captured_at=NOON)
    catalog.surveys.delete(only)
    url, seen, gone = following(document), [], []
    for rel in ("next", "next", "next", "monitor"):
        document = get(client, url + "&limit=2" if "limit" not in url else url)
        assert len(document["features"]) + len(document["withdrawn"]) <= 2
        seen += told(document)
        gone += [one["id"] for one in document["withdrawn"]]
        url = following(document, rel)
    assert seen == [(change_id, True) for change_id in ids[:5]]
    assert gone == ids[5:]
    document = get(client, url)
    assert (document["features"], document["withdrawn"], document["numberMatched"]) == ([], [], 0)


def test_a_change_keeps_its_id_as_a_feature_when_the_survey_that_told_it_is_deleted(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    first, _ = add_survey(catalog, [tile(0, 0)], captured_at=NOON)
    add_survey(catalog, [tile(0, 0)], captured_at=NOON + timedelta(days=1))
    (before,) = get(client, "/maps/lobby/changes")["features"]
    catalog.surveys.delete(first)
    (after,) = get(client, "/maps/lobby/changes")["features"]
    assert before["id"] == after["id"] == after["properties"]["change_id"]
    assert before["properties"]["survey_id"] != after["properties"]["survey_id"]
    (visit,) = get(client, "/maps/lobby/changes", repeats="true")["features"]
    assert visit["id"] == f"{after['properties']['survey_id']}.tile_000_000_000"
    assert get(client, "/maps/lobby/changes", change=after["id"])["features"] == [after]
    assert get(client, "/maps/lobby/changes", change="change-other")["features"] == []


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
