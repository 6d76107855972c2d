"""The API's description: written, whole, and true to the code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from service.api import openapi

PROJECT = Path(__file__).resolve().parents[3]
WRITTEN = PROJECT / openapi.FILE


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
        "POST /maps",
        "GET /maps",
        "GET /maps/{map_id}",
        "DELETE /maps/{map_id}",
        "GET /maps/{map_id}/manifest",
        "GET /maps/{map_id}/cloud.ply",
        "PUT /maps/{map_id}/anchor",
        "DELETE /maps/{map_id}/anchor",
        "POST /maps/{map_id}/versions",
        "GET /maps/{map_id}/versions",
        "GET /maps/{map_id}/versions/{number}",
        "DELETE /maps/{map_id}/versions/{number}",
        "GET /maps/{map_id}/versions/{number}/manifest",
        "GET /maps/{map_id}/versions/{number}/cloud.ply",
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
        "GET /surveys/{survey_id}/picture.png",
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


@pytest.mark.slow
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
