"""OGC API - Processes - Part 1: Core 1.0: the abstract tests of its core, one by one (OGC 18-062r2, Annex A).

Each test bears the name of the abstract tests that it does. Those of `/processes/{processID}/execution` are left out
with the call itself, and that is why `/conformance` does not name the class.
"""

from __future__ import annotations

from typing import Any

import jsonschema
import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.records import Problem
from tests.support import ogc
from tests.support.samples import add_map, add_survey, place, thing, tile


def valid(document: Any, schema: dict[str, Any]) -> None:
    jsonschema.validate(document, schema, format_checker=jsonschema.FormatChecker())


def without_nulls(document: dict[str, Any]) -> dict[str, Any]:
    """A status, without the times that are not known yet: here they are null, the standard leaves them out."""
    return {name: value for name, value in document.items() if value is not None}


def by_rel(document: dict[str, Any]) -> dict[str, str]:
    return {link["rel"]: link["href"] for link in document["links"]}


def test_landingpage(client: TestClient) -> None:
    """/conf/core/landingpage-op, /conf/core/landingpage-success."""
    answer = client.get("/")
    assert answer.status_code == 200
    assert answer.headers["Content-Type"] == "application/json"
    valid(answer.json(), ogc.LANDING_PAGE)
    links = by_rel(answer.json())
    assert {"service-desc", "service-doc"} <= set(links)
    for name in ("conformance", "processes", "job-list"):
        assert client.get(links[f"{ogc.RELATIONS}/{name}"]).status_code == 200


def test_api_definition(client: TestClient) -> None:
    """/conf/core/api-definition-op, /conf/core/api-definition-success."""
    links = by_rel(client.get("/").json())
    assert client.get(links["service-desc"]).json()["openapi"].startswith("3.")
    assert client.get(links["service-doc"]).headers["Content-Type"].startswith("text/html")


def test_conformance(client: TestClient) -> None:
    """/conf/core/conformance-op, /conf/core/conformance-success: and no class is named that does not hold."""
    answer = client.get("/conformance")
    assert answer.status_code == 200
    valid(answer.json(), ogc.CONF_CLASSES)
    assert "http://www.opengis.net/spec/json-fg-1/1.0/conf/core" in answer.json()["conformsTo"]
    assert not [name for name in answer.json()["conformsTo"] if "ogcapi-processes" in name]
    assert client.post("/processes/map/execution", json={"inputs": {}}).status_code == 404


def test_process_list(client: TestClient) -> None:
    """/conf/core/process-list-op (rc: process-list), /conf/core/process-list-success."""
    answer = client.get("/processes")
    assert answer.status_code == 200
    valid(answer.json(), ogc.PROCESS_LIST)
    assert [process["id"] for process in answer.json()["processes"]] == ["map", "survey", "model"]


def test_process_list_limit(client: TestClient) -> None:
    """/conf/core/pl-limit-definition, /conf/core/pl-limit-response, /conf/core/pl-links."""
    seen: list[str] = []
    path: str | None = "/processes?limit=2"
    while path:
        page = client.get(path).json()
        assert len(page["processes"]) <= 2
        seen += [process["id"] for process in page["processes"]]
        assert client.get(by_rel(page)["self"]).json() == page
        path = by_rel(page).get("next")
    assert seen == ["map", "survey", "model"]
    assert client.get("/processes?limit=0").status_code == 422


@pytest.mark.parametrize("process_id", ["map", "survey", "model"])
def test_process(client: TestClient, process_id: str) -> None:
    """/conf/core/process-op, /conf/core/process-success; /conf/ogc-process-description/json-encoding."""
    answer = client.get(f"/processes/{process_id}")
    assert answer.status_code == 200
    valid(answer.json(), ogc.PROCESS)
    document = answer.json()
    assert document["id"] == process_id
    assert "$ref" not in answer.text  # each input stands alone
    assert "scan_ids" in document["inputs"] or process_id == "model"
    assert document["inputs"].get("map_id", {"minOccurs": 1})["minOccurs"] == 1
    listed = client.get("/processes").json()["processes"]
    assert {name: document[name] for name in listed[0]} in listed


def test_process_exception_no_such_process(client: TestClient) -> None:
    """/conf/core/process-exception-no-such-process."""
    answer = client.get("/processes/nothing")
    assert answer.status_code == 404
    valid(answer.json(), ogc.EXCEPTION)
    assert answer.json()["type"] == f"{ogc.EXCEPTIONS}/no-such-process"


def test_job(client: TestClient, catalog: Catalog) -> None:
    """/conf/core/job-op, /conf/core/job-success, /conf/job-list/job-list-op, /conf/job-list/job-list-success."""
    add_map(catalog)
    _, running = add_survey(catalog, ready=False)
    for job_id in (running, catalog.maps.get("lobby").job_id):
        answer = client.get(f"/jobs/{job_id}")
        assert answer.status_code == 200
        valid(without_nulls(answer.json()), ogc.STATUS_INFO)
        assert client.get(f"/processes/{answer.json()['processID']}").status_code == 200
    jobs = client.get("/jobs").json()
    valid({**jobs, "jobs": [without_nulls(job) for job in jobs["jobs"]]}, ogc.JOB_LIST)


def test_job_exception_no_such_job(client: TestClient) -> None:
    """/conf/core/job-exception-no-such-job, but for `type`, which 0.1 has published as ours."""
    answer = client.get("/jobs/nothing")
    assert answer.status_code == 404
    valid(answer.json(), ogc.EXCEPTION)
    assert answer.json()["type"] == "urn:spicd:problem:not_found"


def test_job_results(client: TestClient, catalog: Catalog) -> None:
    """/conf/core/job-results-op, /conf/core/job-results-async-document: every output by reference."""
    map_job = add_map(catalog)
    found = thing(1, now=place(1, 1))
    told, told_job = add_survey(catalog, [tile(0, 0)], objects=[found])
    expected = {
        map_job: {
            "map": "/maps/lobby/versions/1",
            "manifest": "/maps/lobby/versions/1/manifest",
            "cloud": "/maps/lobby/versions/1/cloud.ply",
        },
        told_job: {
            name: f"/surveys/{told}{path}"
            for name, path in (
                ("survey", ""),
                ("tiles", "/tiles"),
                ("objects", "/objects"),
                ("cloud", "/cloud.ply"),
                ("picture", "/picture.png"),
            )
        },
    }
    for job_id, outputs in expected.items():
        job = client.get(f"/jobs/{job_id}").json()
        answer = client.get(by_rel(job)[f"{ogc.RELATIONS}/results"])
        assert answer.status_code == 200
        valid(answer.json(), ogc.RESULTS)
        assert {name: link["href"] for name, link in answer.json().items()} == outputs
        described = client.get(f"/processes/{job['processID']}").json()["outputs"]
        assert set(outputs) <= set(described)


def test_the_results_of_a_survey_of_a_model_without_objects_name_none(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    _, job_id = add_survey(catalog, [tile(0, 0)])
    assert "objects" not in client.get(f"/jobs/{job_id}/results").json()


def test_job_results_exception_no_such_job(client: TestClient) -> None:
    """/conf/core/job-results-exception-no-such-job."""
    answer = client.get("/jobs/nothing/results")
    assert answer.status_code == 404
    valid(answer.json(), ogc.EXCEPTION)
    assert answer.json()["type"] == f"{ogc.EXCEPTIONS}/no-such-job"


def test_job_results_exception_results_not_ready(client: TestClient, catalog: Catalog) -> None:
    """/conf/core/job-results-exception-results-not-ready."""
    job_id = add_map(catalog, ready=False)
    answer = client.get(f"/jobs/{job_id}/results")
    assert answer.status_code == 404
    valid(answer.json(), ogc.EXCEPTION)
    assert answer.json()["type"] == f"{ogc.EXCEPTIONS}/result-not-ready"


@pytest.mark.parametrize("code", ["map_failed", "disk_full"])
def test_job_results_failed(client: TestClient, catalog: Catalog, code: str) -> None:
    """/conf/core/job-results-failed: the reason of the failure, as the job has it, as a conflict."""
    job_id = add_map(catalog, ready=False)
    catalog.jobs.fail(job_id, Problem(code=code, detail="it could not be"))
    answer = client.get(f"/jobs/{job_id}/results")
    assert answer.status_code == answer.json()["status"] == 409
    valid(answer.json(), ogc.EXCEPTION)
    assert answer.json()["type"] == client.get(f"/jobs/{job_id}").json()["problem"]["type"]


def test_job_dismiss(client: TestClient, catalog: Catalog) -> None:
    """/conf/dismiss/job-dismiss-op, /conf/dismiss/job-dismiss-success; its results are told to be dismissed."""
    job_id = add_map(catalog, ready=False)
    answer = client.delete(f"/jobs/{job_id}")
    assert answer.status_code == 200
    valid(without_nulls(answer.json()), ogc.STATUS_INFO)
    assert answer.json()["status"] == "dismissed"
    results = client.get(f"/jobs/{job_id}/results")
    assert (results.status_code, results.json()["type"]) == (409, "urn:spicd:problem:dismissed")
