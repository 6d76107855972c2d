"""Who may ask what: every route has its scopes, and a key admits to those and to its maps alone."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

from service.api.app import create_app
from service.api.http.guards.access import OF_ALL_MAPS, OPEN, SCOPES
from service.catalog.keys import SCOPES as EVERY_SCOPE
from service.catalog.keys import new_secret
from service.settings import Settings
from tests.support.samples import (
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    catalog_of,
    ply,
    running,
    settings_in,
)

RAW = {"Content-Type": "application/octet-stream"}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service that listens beyond loopback, with two maps, each with a survey."""
    settings = settings_in(tmp_path_factory.mktemp("service")).model_copy(update={"host": "0.0.0.0"})
    with running(settings, RememberingQueue()) as client:
        for name in ("lobby", "vault"):
            add_map(catalog_of(client), name)
        yield client


def key_for(client: TestClient, *scopes: str, maps: list[str] | None = None) -> dict[str, str]:
    """The headers of a new key."""
    _, secret = catalog_of(client).keys.add("test", scopes=scopes, maps=maps)
    return {"Authorization": f"Bearer {secret}"}


def code(answer: httpx.Response) -> str:
    if answer.request.method == "HEAD":  # which has no body
        return {401: "unauthorized", 403: "forbidden"}.get(answer.status_code, "ok")
    return str(answer.json()["type"]).rpartition(":")[2] if answer.status_code >= 400 else "ok"


def routes() -> set[tuple[str, str]]:
    """Every route of the API, however it was added; the two pages and the description hold nothing of anybody."""
    app = create_app(Settings())
    described = {
        (method.upper(), path) for path, operations in app.openapi()["paths"].items() for method in operations
    }
    hidden = {
        (method, route.path)
        for route in app.routes
        if isinstance(route, APIRoute) and not route.include_in_schema
        for method in route.methods or ()
    }
    return described | hidden


def filled(path: str) -> str:
    ids = {"{map_id}": "lobby", "{number}": "1", "{scan_id}": "scan-1", "{survey_id}": "survey-1"}
    ids |= {"{upload_id}": 32 * "0", "{job_id}": "job-1", "{object_id}": "object-1"}
    ids |= {"{name}": "spicd-net", "{process_id}": "map"}
    for name, value in ids.items():
        path = path.replace(name, value)
    return path


def test_no_route_is_left_without_scopes_and_no_scope_without_a_route() -> None:
    assert routes() == set(SCOPES)
    assert set(SCOPES) >= OF_ALL_MAPS
    assert {route for route, scopes in SCOPES.items() if scopes == OPEN} == {
        ("GET", "/"),
        ("GET", "/conformance"),
        ("GET", "/processes"),
        ("GET", "/processes/{process_id}"),
        ("GET", "/health/live"),
        ("GET", "/health/ready"),
    }


def test_what_changes_something_takes_a_scope_to_write() -> None:
    for (method, _), scopes in SCOPES.items():
        assert (method == "GET") or all(scope.endswith(":write") for scope in scopes)


@pytest.mark.parametrize(("method", "path"), sorted(SCOPES))
def test_each_route_asks_for_a_key_and_for_the_scope(guarded: TestClient, method: str, path: str) -> None:
    if SCOPES[method, path] == OPEN:
        assert guarded.request(method, filled(path)).status_code == 200
        return
    bare = guarded.request(method, filled(path))
    assert (bare.status_code, code(bare)) == (401, "unauthorized")
    assert bare.headers["WWW-Authenticate"].startswith("Bearer")
    others = [scope for scope in EVERY_SCOPE if scope not in {*SCOPES[method, path], "admin"}]
    refused = guarded.request(method, filled(path), headers=key_for(guarded, *others))
    assert (refused.status_code, code(refused)) == (403, "forbidden")


@pytest.mark.parametrize(("method", "path"), sorted(route for route in SCOPES if route[0] == "GET"))
def test_each_of_its_scopes_admits_to_a_route(guarded: TestClient, method: str, path: str) -> None:
    for scope in [*SCOPES[method, path], "admin"]:
        answer = guarded.request(method, filled(path), headers=key_for(guarded, scope))
        assert answer.status_code not in (401, 403), answer.text


@pytest.mark.parametrize(
    "value",
    ["", "Bearer", "Bearer ", "Basic c3BpY2Q6", "Bearer nonsense", f"Bearer {new_secret()}", "Bearer \xff"],
    ids=["empty", "scheme", "scheme and space", "basic", "nonsense", "unknown", "not ASCII"],
)
def test_what_is_no_key_is_not_let_in(guarded: TestClient, value: str) -> None:
    answer = guarded.get("/maps", headers={"Authorization": value.encode("latin-1")})
    assert (answer.status_code, code(answer)) == (401, "unauthorized")


def test_a_key_in_the_address_is_none(guarded: TestClient) -> None:
    secret = key_for(guarded, "admin")["Authorization"].split()[1]
    for query in (f"?key={secret}", f"?access_token={secret}", f"?api_key={secret}"):
        assert guarded.get(f"/maps{query}").status_code == 401


def test_a_revoked_key_is_refused_at_once(guarded: TestClient) -> None:
    headers = key_for(guarded, "changes:read")
    assert guarded.get("/maps", headers=headers).status_code == 200
    keys = catalog_of(guarded).keys
    keys.revoke(keys.all()[0].key_id)
    assert guarded.get("/maps", headers=headers).status_code == 401


def test_a_robot_uploads_surveys_and_follows_its_job_and_sees_nothing_else(guarded: TestClient) -> None:
    robot = key_for(guarded, "scans:write", "surveys:write", maps=["lobby"])
    scan = guarded.post("/scans", content=ply("robot"), headers={**robot, **RAW}).json()["scan_id"]
    accepted = guarded.post("/maps/lobby/surveys", json={"scan_ids": [scan]}, headers=robot)
    assert accepted.status_code == 202, accepted.text
    assert guarded.get(f"/jobs/{accepted.json()['job_id']}", headers=robot).status_code == 200
    assert guarded.get(f"/surveys/{accepted.json()['survey_id']}", headers=robot).status_code == 200
    for path in ("/scans", "/jobs", "/maps", "/maps/lobby/changes", "/metrics"):
        assert guarded.get(path, headers=robot).status_code == 403
    assert guarded.delete("/maps/lobby", headers=robot).status_code == 403
    elsewhere = guarded.post("/maps/vault/surveys", json={"scan_ids": [scan]}, headers=robot)
    assert (elsewhere.status_code, code(elsewhere)) == (403, "forbidden")


def test_a_bound_key_sees_its_maps_alone_whichever_way_it_asks(guarded: TestClient) -> None:
    catalog = catalog_of(guarded)
    ours, our_job = add_survey(catalog, map_id="lobby")
    theirs, their_job = add_survey(catalog, map_id="vault")
    bound = key_for(guarded, "changes:read", "surveys:write", "maps:write", maps=["lobby"])
    for path in (f"/surveys/{ours}", f"/surveys/{ours}/tiles", f"/jobs/{our_job}", "/maps/lobby/changes"):
        assert guarded.get(path, headers=bound).status_code == 200, path
    for path in (
        "/maps/vault",
        "/maps/vault/versions",
        "/maps/vault/versions/1",
        "/maps/vault/tileset.json",
        "/maps/vault/versions/1/tileset.json",
        "/maps/vault/versions/1/tileset/0123456789abcdef-0-64.glb",
        f"/surveys/{theirs}/tileset.json",
        f"/surveys/{theirs}/tileset/0123456789abcdef-0-64.glb",
        "/maps/vault/changes",
        "/maps/vault/objects",
        "/maps/vault/surveys",
        f"/surveys/{theirs}",
        f"/surveys/{theirs}/tiles",
        f"/surveys/{theirs}/cloud.ply",
        f"/surveys/{theirs}/objects",
        f"/jobs/{their_job}",
        "/maps/none",  # whether it exists is not told either
        "/scans",
        "/metrics",
    ):
        answer = guarded.get(path, headers=bound)
        assert (answer.status_code, code(answer)) == (403, "forbidden"), path
    for method, path in (
        ("DELETE", "/maps/vault"),
        ("DELETE", f"/surveys/{theirs}"),
        ("DELETE", f"/jobs/{their_job}"),
        ("PUT", "/maps/vault/anchor"),
        ("POST", "/maps/vault/versions"),
        ("POST", "/maps/vault/models"),
    ):
        assert guarded.request(method, path, headers=bound).status_code == 403, path
    assert {one["map_id"] for one in guarded.get("/maps", headers=bound).json()["maps"]} == {"lobby"}
    assert {one["map_id"] for one in guarded.get("/jobs", headers=bound).json()["jobs"]} == {"lobby"}
    assert guarded.get("/jobs?map_id=vault", headers=bound).json()["jobs"] == []
    running_there, _ = add_survey(catalog, map_id="vault", ready=False)
    for survey in (theirs, running_there, "survey-none"):
        answer = guarded.get(f"/maps/lobby/changes?survey={survey}", headers=bound)
        assert (answer.status_code, answer.json()["detail"]) == (404, f"no survey '{survey}' of map 'lobby'")
    taken = guarded.post("/maps/lobby/versions", json={"survey_id": theirs}, headers=bound)
    assert taken.status_code in (404, 409, 422)


def test_a_bound_key_makes_its_own_map_and_no_other(guarded: TestClient) -> None:
    scan = add_scan(catalog_of(guarded), "annex").scan_id
    bound = key_for(guarded, "maps:write", maps=["annex"])
    for body in ({"scan_ids": [scan]}, {"scan_ids": [scan], "id": "other"}):
        assert guarded.post("/maps", json=body, headers=bound).status_code == 403
    assert guarded.post("/maps", json={"scan_ids": [scan], "id": "annex"}, headers=bound).status_code == 202


def test_a_model_of_another_map_is_not_there_for_a_bound_key(guarded: TestClient) -> None:
    catalog = catalog_of(guarded)
    model, job = catalog.models.create("vault", minutes=1)
    catalog.models.save_card(job.job_id, {"name": model.name, "version": "1"})
    catalog.jobs.succeed(job.job_id)
    bound = key_for(guarded, "changes:read", "surveys:write", "maps:write", maps=["lobby"])
    assert guarded.get(f"/models/{model.name}", headers=key_for(guarded, "admin")).status_code == 200
    assert guarded.get(f"/models/{model.name}", headers=bound).status_code == 404
    assert model.name not in guarded.get("/models", headers=bound).text
    scan = add_scan(catalog, "visit").scan_id
    body = {"scan_ids": [scan], "model": model.model}
    assert guarded.post("/maps/lobby/surveys", json=body, headers=bound).status_code == 422
    base = guarded.post("/maps/lobby/models", json={"base": model.model}, headers=bound)
    assert base.status_code == 422


def test_a_bound_key_is_shown_the_newest_version_of_its_own(guarded: TestClient) -> None:
    catalog = catalog_of(guarded)
    for map_id in ("lobby", "vault"):
        model, job = catalog.models.create(map_id, name="site-net", minutes=1)
        catalog.models.save_card(job.job_id, {"name": "site-net", "version": model.model.partition("/")[2]})
        catalog.jobs.succeed(job.job_id)
    for key, version in (
        (key_for(guarded, "changes:read", maps=["lobby"]), "1"),
        (key_for(guarded, "admin"), "2"),
    ):
        assert guarded.get("/models/site-net", headers=key).json()["version"] == version
    bound = key_for(guarded, "changes:read", maps=["lobby"])
    assert guarded.get("/models/site-net?version=2", headers=bound).status_code == 404


def test_a_job_is_dismissed_by_who_may_ask_for_its_kind(guarded: TestClient) -> None:
    catalog = catalog_of(guarded)
    _, survey_job = add_survey(catalog, map_id="lobby", ready=False)
    map_job = add_map(catalog, "attic", ready=False)
    surveyor, builder = key_for(guarded, "surveys:write"), key_for(guarded, "maps:write")
    assert guarded.delete(f"/jobs/{map_job}", headers=surveyor).status_code == 403
    assert guarded.delete(f"/jobs/{survey_job}", headers=builder).status_code == 403
    assert guarded.delete(f"/jobs/{survey_job}", headers=surveyor).status_code == 200
    assert guarded.delete(f"/jobs/{map_job}", headers=builder).status_code == 200


def test_on_loopback_no_key_is_needed_and_one_that_comes_counts(client: TestClient) -> None:
    assert client.get("/maps").status_code == 200
    assert client.get("/maps", headers={"Authorization": "Basic c3BpY2Q6"}).status_code == 200
    assert client.get("/maps", headers={"Authorization": "Bearer eyJhbGciOi"}).status_code == 200  # a proxy's
    assert client.get("/maps", headers={"Authorization": f"Bearer {new_secret()}"}).status_code == 401
    reader = key_for(client, "changes:read")
    assert client.get("/maps", headers=reader).status_code == 200
    assert client.delete("/maps/lobby", headers=reader).status_code == 403


def test_the_id_of_the_key_is_there_for_who_shares_workers(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[object] = []
    monkeypatch.setattr("service.api.jobs.maps_of_key", lambda request: seen.append(request.state.key))
    client.get("/jobs")
    client.get("/jobs", headers=key_for(client, "changes:read"))
    assert seen == [None, catalog_of(client).keys.all()[0].key_id]


def test_no_secret_reaches_the_log(client: TestClient, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    headers = key_for(client, "changes:read")
    client.get("/maps", headers=headers)
    client.delete("/maps/lobby", headers=headers)
    client.get("/maps", headers={"Authorization": headers["Authorization"] + "x"})
    secret = headers["Authorization"].removeprefix("Bearer spicd_")
    assert secret not in caplog.text


def test_a_route_that_is_in_no_list_is_nobodys(tmp_path: Path) -> None:
    with running(settings_in(tmp_path), RememberingQueue()) as client:
        app = client.app
        app.add_api_route("/new", lambda: "here")  # type: ignore[attr-defined]
        answer = client.get("/new")
    assert (answer.status_code, code(answer)) == (403, "forbidden")


@pytest.mark.parametrize(
    ("given", "needed"),
    [
        ({}, False),
        ({"host": "localhost"}, False),
        ({"host": "::1"}, False),
        ({"host": "127.8.8.8"}, False),
        ({"host": "0.0.0.0"}, True),
        ({"host": "::"}, True),
        ({"host": "10.0.0.4"}, True),
        ({"host": "lab.example.org"}, True),
        ({"host": "0.0.0.0", "auth": "none"}, False),
        ({"auth": "required"}, True),
    ],
)
def test_a_key_is_needed_as_soon_as_another_machine_can_ask(given: dict[str, str], needed: bool) -> None:
    assert Settings.model_validate(given).requires_key() is needed


def test_the_description_says_which_scope_each_call_takes() -> None:
    document = create_app(Settings()).openapi()
    assert document["components"]["securitySchemes"]["key"]["scheme"] == "bearer"
    assert document["paths"]["/scans"]["post"]["security"] == [{"key": ["scans:write"]}]
    assert document["paths"]["/health/live"]["get"]["security"] == []
    assert {"401", "403"} <= set(document["paths"]["/maps"]["get"]["responses"])
