"""The API's description: written, whole, and true to the code."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fastapi.openapi.utils import get_openapi

from service.api import openapi
from service.api.app import create_app
from service.api.http.description import not_null, operations, schemas_under
from service.catalog.following.deliveries import SCHEDULE
from service.settings import Settings

PROJECT = Path(__file__).resolve().parents[3]
WRITTEN = PROJECT / openapi.FILE
VERBS = frozenset(  #: of operation ids
    [
        "change",
        "create",
        "delete",
        "dismiss",
        "get",
        "list",
        "override",
        "ping",
        "put",
        "repeat",
        "retry",
        "rotate",
        "send",
        "train",
        "upload",
    ]
)


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    written: dict[str, Any] = json.loads(WRITTEN.read_text())
    return written


def test_the_written_description_is_that_of_the_code() -> None:
    assert WRITTEN.read_text() == openapi.written(), "run `python -m service.api.openapi`"


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    def references(node: object) -> set[str]:
        if isinstance(node, dict):
            here = {node["$ref"]} if "$ref" in node else set()
            return here.union(*(references(value) for value in node.values()))
        if isinstance(node, list):
            return set().union(*(references(value) for value in node))
        return set()

    for reference in references(document):
        found = document
        for part in reference.removeprefix("#/").split("/"):
            found = found[part]
        assert found


def test_every_call_of_the_public_api_is_described(document: dict[str, Any]) -> None:
    calls = {f"{method.upper()} {path}" for path, methods in document["paths"].items() for method in methods}
    assert calls == {
        "POST /scans",
        "GET /scans",
        "GET /scans/{scan_id}",
        "DELETE /scans/{scan_id}",
        "OPTIONS /uploads",
        "POST /uploads",
        "HEAD /uploads/{upload_id}",
        "GET /uploads/{upload_id}",
        "PATCH /uploads/{upload_id}",
        "POST /uploads/{upload_id}",
        "DELETE /uploads/{upload_id}",
        "POST /maps",
        "GET /maps",
        "GET /maps/{map_id}",
        "DELETE /maps/{map_id}",
        "GET /maps/{map_id}/scans",
        "GET /maps/{map_id}/manifest",
        "GET /maps/{map_id}/cloud.ply",
        "GET /maps/{map_id}/tileset.json",
        "GET /maps/{map_id}/cloud.laz",
        "PUT /maps/{map_id}/anchor",
        "DELETE /maps/{map_id}/anchor",
        "POST /maps/{map_id}/versions",
        "GET /maps/{map_id}/versions",
        "GET /maps/{map_id}/versions/{number}",
        "DELETE /maps/{map_id}/versions/{number}",
        "GET /maps/{map_id}/versions/{number}/scans",
        "GET /maps/{map_id}/versions/{number}/manifest",
        "GET /maps/{map_id}/versions/{number}/cloud.ply",
        "GET /maps/{map_id}/versions/{number}/tileset.json",
        "GET /maps/{map_id}/versions/{number}/tileset/{content}",
        "GET /maps/{map_id}/versions/{number}/cloud.laz",
        "POST /maps/{map_id}/models",
        "POST /maps/{map_id}/surveys",
        "GET /maps/{map_id}/surveys",
        "GET /maps/{map_id}/changes",
        "GET /maps/{map_id}/objects",
        "GET /maps/{map_id}/objects/{object_id}",
        "GET /surveys/{survey_id}/objects",
        "GET /surveys/{survey_id}",
        "DELETE /surveys/{survey_id}",
        "GET /surveys/{survey_id}/tiles",
        "GET /surveys/{survey_id}/cloud.ply",
        "GET /surveys/{survey_id}/cloud.laz",
        "GET /surveys/{survey_id}/picture.png",
        "GET /surveys/{survey_id}/tileset.json",
        "GET /surveys/{survey_id}/tileset/{content}",
        "GET /",
        "GET /conformance",
        "GET /processes",
        "GET /processes/{process_id}",
        "GET /jobs/{job_id}/results",
        "GET /jobs",
        "GET /jobs/{job_id}",
        "DELETE /jobs/{job_id}",
        "POST /jobs/{job_id}/retry",
        "GET /events",
        "POST /webhooks",
        "GET /webhooks",
        "GET /webhooks/{webhook_id}",
        "PATCH /webhooks/{webhook_id}",
        "DELETE /webhooks/{webhook_id}",
        "POST /webhooks/{webhook_id}/ping",
        "POST /webhooks/{webhook_id}/rotate",
        "GET /webhooks/{webhook_id}/deliveries",
        "POST /webhooks/{webhook_id}/deliveries/{delivery_id}/repeat",
        "GET /models",
        "GET /models/{name}",
        "GET /health/live",
        "GET /health/ready",
        "GET /metrics",
    }


def test_every_error_is_described_as_a_problem(document: dict[str, Any]) -> None:
    for path, methods in document["paths"].items():
        for method, call in methods.items():
            for status, answer in call["responses"].items():
                if int(status) >= 400:
                    content = answer["content"]
                    assert list(content) == ["application/problem+json"], (method, path, status)


def test_uploads_describe_their_body(document: dict[str, Any]) -> None:
    bodies = {
        path: list(document["paths"][path]["post"]["requestBody"]["content"]) for path in ("/scans", "/maps")
    }
    assert bodies == {
        "/scans": ["application/octet-stream", "multipart/form-data"],
        "/maps": ["application/json", "multipart/form-data"],
    }


def parts(node: object, place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every object of the document, with the place where it stands."""
    if isinstance(node, dict):
        yield place, node
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for name, child in children:
        yield from parts(child, f"{place}/{name}")


def test_every_operation_bears_the_name_of_one_function_that_is_a_verb_and_a_noun(
    document: dict[str, Any],
) -> None:
    ids = [operation["operationId"] for operation in operations(document)]
    assert len(set(ids)) == len(ids)
    for name in ids:
        assert re.fullmatch(r"[a-z]+(_[a-z]+)+", name), name
        assert name.split("_")[0] in VERBS, name


def test_no_reference_stands_beside_a_type(document: dict[str, Any]) -> None:
    wrong = [place for place, part in parts(document) if "$ref" in part and "type" in part]
    assert wrong == []


def test_lists_are_bounded_by_items_and_texts_by_letters(document: dict[str, Any]) -> None:
    lists = {"minItems", "maxItems", "uniqueItems"}
    texts = {"minLength", "maxLength", "pattern"}
    for place, part in parts(document["components"]["schemas"]):
        of = {"array": texts, "string": lists}.get(str(part.get("type")), set())
        assert not of & part.keys(), place


def test_no_request_has_to_send_what_has_a_default(document: dict[str, Any]) -> None:
    sent = [operation["requestBody"] for operation in operations(document) if "requestBody" in operation]
    for name, schema in schemas_under(sent, document).items():
        for field, described in schema.get("properties", {}).items():
            assert "default" not in described, f"{name}.{field}: generators take it for always there"


def test_answers_have_every_member_that_the_service_writes(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    assert "warnings" in schemas["ScanOutcome"]["required"]
    assert "queue_position" in schemas["JobDocument"]["required"]
    assert "errors" not in schemas["ProblemDocument"]["required"]


def test_parameters_are_left_out_and_never_null(document: dict[str, Any]) -> None:
    for operation in operations(document):
        for parameter in operation.get("parameters", ()):
            assert not_null(parameter["schema"]) == parameter["schema"], (operation, parameter["name"])


def test_forms_admit_their_own_files_and_no_other_field(document: dict[str, Any]) -> None:
    forms = {
        operation["operationId"]: operation["requestBody"]["content"]["multipart/form-data"]["schema"]
        for operation in operations(document)
        if "multipart/form-data" in operation.get("requestBody", {}).get("content", {})
    }
    assert len(forms) >= 4
    for name, reference in forms.items():
        schema = next(iter(schemas_under(reference, document).values()))
        files = "file" if name == "upload_scan" else "scans"
        binary = schema["properties"][files]
        assert (binary if files == "file" else binary["items"])["format"] == "binary"
        assert schema["additionalProperties"] is False
        assert "allOf" not in schema


def test_bounds_and_defaults_of_parameters_stand_in_words(document: dict[str, Any]) -> None:
    """Generators of TypeScript show descriptions, and no numbers of schemas."""

    def said(path: str, name: str) -> str:
        parameters = document["paths"][path]["get"]["parameters"]
        return str(next(one["description"] for one in parameters if one["name"] == name))

    assert said("/maps", "limit") == "most items in one answer; 1 to 1000; left out: 100"
    assert said("/surveys/{survey_id}/tiles", "limit").endswith("left out: all there are; 1 to 10000")
    assert said("/maps/{map_id}/changes", "min_score").endswith("; 0 to 1")
    assert "; 0 to 60; left out: 0" in said("/events", "wait")
    assert "left out: false" in said("/maps/{map_id}/changes", "repeats")
    assert "min x, min y, min z, max x, max y, max z" in said("/maps/{map_id}/changes", "bbox")
    for operation in operations(document):
        for parameter in operation.get("parameters", ()):
            if parameter["in"] == "query" and "maximum" in parameter["schema"]:
                assert f"to {parameter['schema']['maximum']}" in parameter["description"], parameter["name"]


def test_what_an_answer_leaves_out_is_not_null(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    for name, members in (
        ("ProblemDocument", ("status", "instance", "errors")),
        ("TileCollection", ("crs", "cursor", "withdrawn")),
        ("ObjectHistory", ("crs",)),
    ):
        for member in members:
            assert member not in schemas[name]["required"]
            described = schemas[name]["properties"][member]
            assert not_null(described) == described
    for place, part in parts(schemas):
        assert "default" not in part or part["default"] is not None, place


def test_who_makes_something_is_told_where_it_is(document: dict[str, Any]) -> None:
    for path, methods in document["paths"].items():
        for method, call in methods.items():
            headers = {
                name
                for status in ("201", "202")
                for name in call["responses"].get(status, {}).get("headers", ())
            }
            if "201" in call["responses"]:
                assert headers == {"Location"}, (method, path)
            elif "202" in call["responses"] and not path.startswith("/webhooks"):
                assert headers == {"Location", "Retry-After"}, (method, path)
    assert "Retry-After" in document["paths"]["/jobs/{job_id}"]["get"]["responses"]["200"]["headers"]


def test_an_id_that_is_none_of_a_map_has_an_example_of_its_own(document: dict[str, Any]) -> None:
    for operation in operations(document):
        for parameter in operation.get("parameters", ()):
            if parameter["schema"].get("examples") == ["lobby"]:
                assert parameter["name"] in ("map_id", "map")
    schemas = document["components"]["schemas"]
    assert schemas["VersionForm"]["properties"]["survey_id"]["examples"] == ["survey-91c4"]
    assert schemas["ScanUse"]["properties"]["scan_id"]["examples"] == ["scan-2b1f"]


def test_a_receiver_of_webhooks_is_told_what_it_gets(document: dict[str, Any]) -> None:
    call = document["webhooks"]["event"]["post"]
    assert [one["name"] for one in call["parameters"]] == [
        "webhook-id",
        "webhook-timestamp",
        "webhook-signature",
    ]
    assert list(call["requestBody"]["content"]) == ["application/cloudevents+json"]
    units = ((3600, "h"), (60, "min"), (1, "s"))
    waits = [
        next((wait.seconds // size, unit) for size, unit in units if wait.seconds >= size)
        for wait in SCHEDULE
    ]
    words = [f"{count} {unit}" for count, unit in waits]
    assert f"after {', '.join(words[:-1])} and {words[-1]}" in call["description"]
    sent = schemas_under(call, document)
    assert {"WebhookEvent", "PingEvent", "ChangeEvent", "ChangeData"} <= sent.keys()


def test_a_stream_is_described_with_its_framing(document: dict[str, Any]) -> None:
    content = document["paths"]["/events"]["get"]["responses"]["200"]["content"]
    said = content["text/event-stream"]["schema"]["description"]
    assert all(word in said for word in ("retry: 2000", "`sequence`", "15 s", "onmessage"))


@pytest.mark.slow
def test_first_requests_that_come_together_have_it_made_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app, made, real = create_app(Settings(data_dir=tmp_path)), [], get_openapi

    def slowly(**given: Any) -> dict[str, Any]:
        made.append(threading.current_thread().name)
        time.sleep(0.05)
        return real(**given)

    monkeypatch.setattr("service.api.app.get_openapi", slowly)
    with ThreadPoolExecutor(4) as pool:
        documents = list(pool.map(lambda _: app.openapi(), range(4)))
    assert len(made) == 1
    assert all(document is documents[0] for document in documents)


def test_importing_the_api_brings_neither_torch_nor_the_worker() -> None:
    import subprocess
    import sys

    code = (
        "import sys, service.api.app; "
        "print([name for name in ('torch', 'open3d', 'worker', 'numpy') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=PROJECT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
