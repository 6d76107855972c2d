"""Requests made to do harm: each ends in its problem, soon, and in an answer that is no longer than it has to be."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.api.http.answering.json_text import MAX_NAMES, read_json
from service.api.http.answering.problems import MAX_ERRORS
from tests.support.samples import (
    RememberingQueue,
    add_map,
    add_survey,
    catalog_of,
    place,
    ply,
    running,
    settings_in,
    thing,
    tile,
)

NOON = "2026-03-01T12:00:00Z"
JSON = {"Content-Type": "application/json"}
RAW = {"Content-Type": "application/octet-stream"}
FORM = {"Content-Type": "multipart/form-data; boundary=b"}
DEEP = ["[" * 5000, '{"a":' * 5000, "[1," * 3000, "[" * 100_000]


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service with a map and a survey of it."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        add_map(catalog_of(client), "lobby")
        add_survey(catalog_of(client), [tile(0, 0)], objects=[thing(1, now=place(1, 1))])
        yield client


def cursor(*parts: object) -> str:
    return base64.urlsafe_b64encode(json.dumps(parts).encode()).decode().rstrip("=")


@pytest.mark.parametrize(
    "parts",
    [
        (NOON, "s", "0x1p99999", "t"),
        (NOON, "s", "nan", "t"),
        (NOON, "s", "inf", "t"),
        (NOON, "\ud800", "0x1p0", "t"),
        (NOON, "s", "0x1p0", "\x00"),
        (NOON, "\ud800"),
        (NOON, "\x00"),
        (NOON, "ä"),
        (NOON, 5),
        (NOON, None),
        (NOON, ["a"]),
        (10**400,),
        ("9" * 30,),
        ("-1",),
        ("١",),
        (float("inf"),),
        (True,),
    ],
    ids=ascii,
)
@pytest.mark.parametrize(
    "path",
    [
        "/scans",
        "/maps",
        "/jobs",
        "/maps/lobby/surveys",
        "/maps/lobby/versions",
        "/maps/lobby/changes",
        "/maps/lobby/objects",
        "/surveys/{survey}/objects",
    ],
)
def test_a_cursor_that_is_none_of_ours_never_reaches_the_database(
    asked: TestClient, path: str, parts: tuple[object, ...]
) -> None:
    (survey,) = catalog_of(asked).surveys.page("lobby").items
    answer = asked.get(path.format(survey=survey.survey_id), params={"cursor": cursor(*parts)})
    assert answer.status_code == 422, answer.text


@pytest.mark.parametrize("letters", [71, 300, 1_000_000])
def test_a_boundary_that_no_form_has_is_refused(asked: TestClient, letters: int) -> None:
    headers = {"Content-Type": f"multipart/form-data; boundary={'b' * letters}"}
    answer = asked.post("/maps", content=b"--b\r\n", headers=headers)
    assert answer.status_code == 422
    assert "boundary" in answer.json()["detail"]


@pytest.mark.parametrize("header", ["X-A: " + "a" * 100_000, "A: b\r\n" * 5000], ids=["long", "many"])
def test_headers_of_a_part_are_bounded(asked: TestClient, header: str) -> None:
    answer = asked.post("/scans", content=f"--b\r\n{header}\r\n\r\n", headers=FORM)
    assert (answer.status_code, "Maximum header" in answer.json()["detail"]) == (422, True)


@pytest.mark.parametrize("text", DEEP, ids=lambda text: text[:6])
def test_nesting_ends_in_a_sentence_wherever_json_is_read(asked: TestClient, text: str) -> None:
    for name in ("settings", "anchor", "scan_ids"):
        part = f'--b\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{text}\r\n--b--\r\n'
        assert asked.post("/maps", content=part.encode(), headers=FORM).status_code == 422
    assert asked.post("/maps", content=text.encode(), headers=JSON).status_code == 422
    if len(text) < 50_000:
        answer = asked.post("/scans", params={"pose": text}, content=ply(), headers=RAW)
        assert answer.status_code == 422


@pytest.mark.parametrize("number", ["1e400", "-1e400", "NaN", "Infinity", "9" * 4000, "9" * 5000, "1e-400"])
def test_numbers_that_nothing_holds_are_refused(asked: TestClient, number: str) -> None:
    for body in (
        f'{{"scan_ids": ["a"], "threshold": {number}}}',
        f'{{"scan_ids": ["a"], "threshold": [{number}]}}',
        f'{{"scan_ids": [{number}]}}',
    ):
        answer = asked.post("/maps/lobby/surveys", content=body.encode(), headers=JSON)
        assert answer.status_code in (404, 422), answer.text
    assert asked.get("/maps/lobby/changes", params={"limit": number}).status_code == 422
    assert asked.get("/maps/lobby/changes", params={"bbox": f"{number},0,0,0"}).status_code in (200, 422)


@pytest.mark.parametrize(
    "body",
    [
        "{" + '"a":1,' * 60_000 + '"b":2}',
        "{" + ",".join(f'"k{n}":1' for n in range(60_000)) + "}",
        '{"settings":{' + ",".join(f'"k{n}":1' for n in range(60_000)) + "}}",
        '{"scan_ids":[' + ",".join(['"!"'] * 200_000) + "]}",
        '{"scan_ids":["' + "a,b," * 200_000 + '"]}',
    ],
    ids=["one name", "many names", "many names within", "a long list", "a long name"],
)
def test_thousands_of_mistakes_cost_no_more_than_one(asked: TestClient, body: str) -> None:
    started = time.perf_counter()
    answer = asked.post("/maps", content=body.encode(), headers=JSON)
    assert time.perf_counter() - started < 1.0  # 60,000 names took 1.1 s and the list 2.8 s
    assert answer.status_code == 422
    assert len(answer.content) < 10_000


def test_an_answer_names_some_of_the_mistakes_alone(asked: TestClient) -> None:
    answer = asked.get("/maps?" + "&".join(f"a{number}=1" for number in range(3000)))
    assert answer.status_code == 422
    assert len(answer.json()["errors"]) == MAX_ERRORS


@pytest.mark.parametrize("name", ["\x00", "\udcff", "a" * 5000, "../../x", "a\nb", "\u202egpj.exe", '"', ";"])
def test_a_file_name_is_a_name_and_no_more(asked: TestClient, name: str) -> None:
    part = b'--b\r\nContent-Disposition: form-data; name="file"; filename="'
    part += name.encode("utf-8", "surrogateescape") + b'"\r\n\r\n' + ply(ascii(name)) + b"\r\n--b--\r\n"
    answer = asked.post("/scans", content=part, headers=FORM)
    assert answer.status_code in (201, 422), answer.text


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"a": 1, "a": 2}', "stands twice"),
        ('{"x": {"a": 1, "b": 2, "a": 2}}', "'a' stands twice"),
        ("[" * 100_000, "nested too deeply"),
        ("{" + ",".join(f'"{n}":0' for n in range(MAX_NAMES + 1)) + "}", "more than"),
        ("9" * 5000, "digits"),
        ("", "Expecting value"),
    ],
)
def test_json_that_costs_or_means_more_than_it_says_is_a_value_error(text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read_json(text)


def test_sound_json_is_read_as_it_is() -> None:
    value: Any = {"a": [1, {"b": None}], "c": {"a": "é"}}
    assert read_json(json.dumps(value)) == value
    assert read_json(json.dumps(value, ensure_ascii=False).encode()) == value
