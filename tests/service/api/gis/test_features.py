"""Forms of features: plain GeoJSON, JSON-FG and tables, and how a client asks for each."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.api.gis.boxes import CRS84H
from service.api.gis.features import CSV, JSON_FG, MEDIA_TYPE, Form, Kind, _rows
from service.api.http.answering.documents import Document
from service.api.objects import ObjectCollection, ObjectHistory, SightingCollection
from service.api.tiles import FgTileCollection, TileCollection
from service.tile_features import MAP_FRAME, MAP_FRAME_WKT
from tests.service.api.test_objects import BERLIN, add_story
from tests.support.samples import RememberingQueue, catalog_of, running, settings_in

PROFILES = "http://www.opengis.net/def/profile/OGC/0/"
SHAPES: dict[str, type[Document]] = {
    "objects": ObjectCollection,
    "object": ObjectHistory,
    "sightings": SightingCollection,
}
ANSWERS = ("tiles", "sightings", "changes", "objects", "object")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[TestClient, dict[str, str]]]:
    """A service with three visits, and the address of each answer of features."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        first, *_ = add_story(catalog_of(client))
        (thing, *_) = client.get("/maps/lobby/objects").json()["features"]
        yield (
            client,
            {
                "tiles": f"/surveys/{first}/tiles",
                "sightings": f"/surveys/{first}/objects",
                "changes": f"/maps/lobby/changes?survey={first}&state=unchanged",
                "objects": "/maps/lobby/objects",
                "object": f"/maps/lobby/objects/{thing['id']}",
            },
        )


def get(served: tuple[TestClient, dict[str, str]], what: str, query: str = "", **headers: str) -> Any:
    client, addresses = served
    address = addresses[what]
    joint = "&" if "?" in address else "?"
    return client.get(f"{address}{joint}{query}" if query else address, headers=headers)


def features_of(body: dict[str, Any]) -> list[dict[str, Any]]:
    return body.get("features") or [body, *body["sightings"]]


def table(answer: Any) -> list[dict[str, str]]:
    assert answer.status_code == 200, answer.text
    return list(csv.DictReader(io.StringIO(answer.text, newline="")))


@pytest.mark.parametrize("what", ANSWERS)
def test_whoever_asks_for_nothing_else_gets_plain_geojson(served: Any, what: str) -> None:
    for query in ("", "profile=rfc7946", "f=json"):
        answer = get(served, what, query)
        assert answer.headers["content-type"] == MEDIA_TYPE
        body = answer.json()
        assert not {"conformsTo", "featureType", "coordRefSys", "place", "time", "crs"} & set(body)
        for feature in features_of(body):
            assert not {"place", "time", "featureType", "coordRefSys"} & set(feature)
            assert feature["geometry"] is None
        links = {link["rel"]: link["href"] for link in body["links"]}
        assert links["profile"] == f"{PROFILES}rfc7946"
        assert f'<{PROFILES}rfc7946>; rel="profile"' in answer.headers["link"]
        assert answer.headers["vary"] == "Accept, Accept-Encoding"
        assert "content-crs" not in answer.headers  # there are no coordinates
    SHAPES.get(what, TileCollection).model_validate_json(answer.content)


@pytest.mark.parametrize("what", ANSWERS)
def test_json_fg_is_there_on_request(served: Any, what: str) -> None:
    for answer in (get(served, what, "profile=jsonfg"), get(served, what, accept=JSON_FG)):
        assert answer.headers["content-type"] == JSON_FG
        assert f'<{PROFILES}jsonfg>; rel="profile"' in answer.headers["link"]
        body = answer.json()
        assert all(feature["place"]["type"] == "Prism" for feature in features_of(body))
        assert {"rel": "profile", "href": f"{PROFILES}jsonfg", "type": "text/html"} in body["links"]
        if "features" in body:
            assert body["coordRefSys"] == MAP_FRAME
    if what in ("tiles", "changes"):
        FgTileCollection.model_validate_json(answer.content)


@pytest.mark.parametrize("what", ANSWERS)
def test_local_metres_are_there_on_request_and_say_what_they_are(served: Any, what: str) -> None:
    for crs in ("map", MAP_FRAME):
        answer = get(served, what, f"crs={crs}")
        assert answer.headers["content-crs"] == f"<{MAP_FRAME}>"
        body = answer.json()
        assert body["crs"] == {"type": "name", "properties": {"name": MAP_FRAME_WKT}}
        fg = get(served, what, "profile=jsonfg").json()
        for feature, prism in zip(features_of(body), features_of(fg), strict=True):
            (ring,) = feature["geometry"]["coordinates"]
            assert [corner[:2] for corner in ring] == prism["place"]["base"]["coordinates"][0]
            assert {corner[2] for corner in ring} == {prism["place"]["lower"]}


def test_on_the_earth_the_frame_is_told_in_a_header(served: Any) -> None:
    client, _ = served
    client.put("/maps/lobby/anchor", json=BERLIN)
    try:
        for query in ("", "crs=CRS84", "f=csv"):
            assert get(served, "tiles", query).headers["content-crs"] == f"<{CRS84H}>"
        both = get(served, "tiles", "profile=jsonfg&crs=map").json()["features"][0]
        assert both["geometry"]["coordinates"][0][0][0] == pytest.approx(13.4)  # beside `place`, in metres
    finally:
        client.delete("/maps/lobby/anchor")


@pytest.mark.parametrize("what", ANSWERS)
def test_a_table_has_a_row_for_each_feature_and_its_flat_properties(served: Any, what: str) -> None:
    body = get(served, what, "crs=map").json()
    features = body.get("features") or [body]
    for answer in (get(served, what, "f=csv&crs=map"), get(served, what, "crs=map", accept="text/csv")):
        assert answer.headers["content-type"] == "text/csv; header=present; charset=utf-8"
        assert answer.text.count("\r\n") == len(features) + 1
        rows = table(answer)
        for row, feature in zip(rows, features, strict=True):
            flat = {
                name: value
                for name, value in feature["properties"].items()
                if not isinstance(value, (list, dict)) and name in row
            }
            nested = set(feature["properties"]) - set(row)
            assert nested <= {"tile_index", "center", "probabilities", "now", "before", "motion"}
            assert row["id"] == feature["id"]
            assert float(row["z_max"]) == flat["z_max"]
            assert row["WKT"].startswith("POLYGON Z ((")
            assert {name for name, value in flat.items() if value is None} <= {
                name for name, text in row.items() if text == ""
            }


def test_a_table_tells_its_pages_in_headers(served: Any) -> None:
    seen: list[str] = []
    client, addresses = served
    url: str | None = f"{addresses['objects']}?f=csv&limit=2&sortby=probability"
    while url:
        answer = client.get(url)
        assert (answer.headers["ogc-numbermatched"], answer.headers["vary"]) == (
            "3",
            "Accept, Accept-Encoding",
        )
        rows = table(answer)
        assert int(answer.headers["ogc-numberreturned"]) == len(rows)
        seen += [row["probability"] for row in rows]
        url = answer.links.get("next", {}).get("url")
    assert seen == ["0.7", "0.8", "0.9"]


def test_a_table_without_rows_has_its_header(served: Any) -> None:
    answer = get(served, "objects", "f=csv&status=new")
    assert answer.text.startswith("id,object_id,number,kind,")
    assert answer.text.count("\r\n") == 1


def test_what_a_spreadsheet_would_take_for_a_formula_is_none(served: Any) -> None:
    kind = Kind(feature_type="any", columns=("name", "number", "is_so", "text"))
    hostile = {"name": '=HYPERLINK("http://evil")', "number": -1.5, "is_so": True, "text": 'a "b", c\nd'}
    text = "".join(_rows(kind, [{"id": "-1+1", "properties": hostile, "geometry": None}]))
    header, row = csv.reader(io.StringIO(text, newline=""))
    assert header == ["id", "name", "number", "is_so", "text", "WKT"]
    assert row == ["'-1+1", '\'=HYPERLINK("http://evil")', "-1.5", "true", 'a "b", c\nd', ""]
    for start in "+@\t\r\n":
        text = "".join(_rows(kind, [{"id": f"{start}x", "properties": {}, "geometry": None}]))
        assert list(csv.reader(io.StringIO(text, newline="")))[1][0] == f"'{start}x"


def test_a_long_table_is_sent_in_pieces() -> None:
    kind = Kind(feature_type="any", columns=())
    pieces = list(_rows(kind, [{"id": str(n), "properties": {}, "geometry": None} for n in range(1200)]))
    assert [piece.count("\r\n") for piece in pieces] == [501, 500, 200]


@pytest.mark.parametrize(
    ("accept", "media_type"),
    [
        ("text/csv;q=0.5, application/geo+json", MEDIA_TYPE),
        ("application/json", MEDIA_TYPE),
        (f"{JSON_FG}, application/json;q=0.9", JSON_FG),
        ("text/html,application/xhtml+xml,*/*;q=0.8", MEDIA_TYPE),
    ],
)
def test_accept_is_weighed(served: Any, accept: str, media_type: str) -> None:
    assert get(served, "tiles", accept=accept).headers["content-type"] == media_type


def test_where_nothing_fits_a_problem_says_what_there_is(served: Any) -> None:
    answer = get(served, "tiles", accept="image/png")
    assert answer.status_code == 406
    assert answer.json()["type"] == "urn:spicd:problem:not_acceptable"
    assert "text/csv" in answer.json()["detail"]
    assert get(served, "tiles", "f=csv", accept="image/png").status_code == 200  # the query goes before


@pytest.mark.parametrize("query", ["f=xml", "profile=gml", "crs=EPSG:4326", "f=csv&profile=jsonfg"])
def test_a_form_that_there_is_not_is_refused(served: Any, query: str) -> None:
    assert get(served, "tiles", query).status_code == 422


def test_other_forms_are_linked_to(served: Any) -> None:
    client, _ = served
    links = get(served, "changes", "limit=1").json()["links"]
    others = {link["type"]: link["href"] for link in links if link["rel"] == "alternate"}
    assert set(others) == {JSON_FG, CSV}
    for media_type, href in others.items():
        answer = client.get(href)
        assert answer.headers["content-type"].startswith(media_type)
    following = next(link for link in links if link["rel"] == "next")
    assert following["type"] == MEDIA_TYPE


def test_a_form_has_no_frame_where_there_are_no_coordinates() -> None:
    assert Form(media_type=MEDIA_TYPE, in_map_frame=False, convert=None).crs is None
