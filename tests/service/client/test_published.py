"""What the client publishes, and that both of its forms are one."""

from __future__ import annotations

import importlib.util
import inspect
from types import ModuleType
from typing import Any

import pytest

import service.client
from service.client import AsyncClient, Client
from tests.support.tools import TOOLS, needs_tools
from tests.test_imports import ROOT

#: Names that people import; one that goes breaks their programs.
NAMES = {
    "DEFAULT_URL",
    "AsyncClient",
    "ChangesPage",
    "Client",
    "ClientError",
    "Delivery",
    "Document",
    "Event",
    "JobFailed",
    "NewWebhook",
    "OnProgress",
    "OnReceived",
    "OnSent",
    "Pose",
    "RequestRefused",
    "Retries",
    "Unreachable",
    "Webhook",
    "sentence",
}
#: Methods, with the parameters that may be named.
METHODS = {
    "change_webhook": "webhook_id url types status",
    "changes": "map_id filters",
    "changes_csv": "map_id filters",
    "create_map": "scan_ids map_id name model settings anchor poses idempotency_key",
    "create_version": "map_id scan_ids survey_id poses idempotency_key",
    "create_webhook": "url types map_id",
    "delete_map": "map_id",
    "delete_scan": "scan_id",
    "delete_survey": "survey_id",
    "delete_version": "map_id version",
    "delete_webhook": "webhook_id",
    "deliveries": "webhook_id",
    "dismiss": "job_id",
    "download": "path to on_received resume",
    "events": "types map_id after",
    "follow_changes": "map_id after every_s filters",
    "job": "job_id",
    "jobs": "",
    "map": "map_id",
    "map_scans": "map_id",
    "maps": "",
    "model": "model",
    "models": "",
    "next_page": "page",
    "object": "map_id object_id",
    "objects": "map_id filters",
    "ping_webhook": "webhook_id",
    "repeat_delivery": "webhook_id delivery_id",
    "retry": "job_id",
    "rotate_webhook": "webhook_id",
    "scan": "scan_id",
    "scans": "",
    "set_anchor": "map_id anchor",
    "submit_survey": "map_id scan_ids captured_at device_id model threshold poses idempotency_key",
    "survey": "survey_id",
    "survey_objects": "survey_id filters",
    "surveys": "map_id",
    "tiles": "survey_id",
    "train_model": "map_id name base minutes epochs",
    "upload_scan": "source filename device_id captured_at pose frame on_sent",
    "upload_scan_resumable": "path memory persistence on_sent on_wait said",
    "version": "map_id version",
    "version_scans": "map_id version",
    "versions": "map_id",
    "wait": "job_id on_progress every_s",
    "webhook": "webhook_id",
    "webhooks": "",
}


def methods(kind: type[Any]) -> dict[str, str]:
    return {
        name: " ".join(list(inspect.signature(method).parameters)[1:])
        for name, method in inspect.getmembers(kind, inspect.isfunction)
        if not name.startswith("_")
    }


@pytest.fixture
def making() -> ModuleType:
    spec = importlib.util.spec_from_file_location("making", ROOT / ".ci/client.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_published_names_are_these() -> None:
    assert set(service.client.__all__) == NAMES
    assert all(hasattr(service.client, name) for name in NAMES)


def test_both_clients_have_the_same_methods_and_these() -> None:
    assert methods(Client) == METHODS | {"close": ""}
    assert methods(AsyncClient) == METHODS | {"aclose": ""}


def test_every_method_of_the_asynchronous_client_is_asynchronous() -> None:
    for name in METHODS:
        method = getattr(AsyncClient, name)
        assert inspect.iscoroutinefunction(method) or inspect.isasyncgenfunction(method), name


@pytest.mark.slow
def test_what_is_made_of_the_asynchronous_source_is_current(making: ModuleType) -> None:
    assert [name for name in making.outdated() if "documents" not in name] == []


@pytest.mark.slow
@needs_tools
def test_the_documents_are_those_of_the_api(making: ModuleType) -> None:
    assert (TOOLS / "bin" / "datamodel-codegen").exists()
    assert making.outdated() == []
