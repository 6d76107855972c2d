"""Query parameters that a route does not know, on every route."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient

from service.settings import Settings
from tests.service.api.http.guards.test_access import filled, routes
from tests.support.samples import RememberingQueue, add_map, catalog_of, running, settings_in


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service with a map, for requests that change nothing."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        add_map(catalog_of(client))
        yield client


@pytest.mark.parametrize(("method", "path"), sorted(routes()))
def test_no_route_takes_a_parameter_that_it_does_not_know(client: TestClient, method: str, path: str) -> None:
    answer = client.request(method, filled(path), params={"of_no_route": "x" * 300})
    assert answer.status_code == 422, answer.text
    if method == "HEAD":  # it has no body
        return
    problem = answer.json()
    assert problem["type"] == "urn:spicd:problem:invalid_request"
    assert [error["place"] for error in problem["errors"]] == ["query.of_no_route"]
    assert "there is no such parameter" in problem["detail"]
    assert len(answer.content) < 2000


def test_the_parameters_that_there_are_stand_in_the_problem(client: TestClient) -> None:
    answer = client.get("/surveys/survey-1/tiles?stat=changed&bbox_crs=map&limit=1")
    problem = answer.json()
    assert [error["place"] for error in problem["errors"]] == ["query.stat", "query.bbox_crs"]
    assert "bbox, bbox-crs, crs" in problem["detail"]
    answer = client.delete("/maps/lobby?force=true")
    assert (answer.status_code, "has none" in answer.json()["detail"]) == (422, True)
    assert client.get("/maps/lobby").status_code == 200  # it stands


def test_pages_for_people_are_left_alone(client: TestClient) -> None:
    for path in ("/docs", "/redoc", "/openapi.json"):
        assert client.get(path, params={"theme": "dark"}).status_code == 200


def test_whoever_may_not_ask_learns_no_parameters(tmp_path_factory: pytest.TempPathFactory) -> None:
    settings: Settings = settings_in(tmp_path_factory.mktemp("guarded"))
    with running(settings.model_copy(update={"host": "0.0.0.0"}), RememberingQueue()) as guarded:
        assert guarded.get("/maps?of_no_route=1").status_code == 401
