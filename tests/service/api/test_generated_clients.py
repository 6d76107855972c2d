"""Clients that generators of other people make of the OpenAPI document, without a warning."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.tools import ROOT, needs_tools, run

DOCUMENT = ROOT / "openapi" / "openapi.json"
SETTINGS = ROOT / "openapi" / "python-client.yaml"

pytestmark = [needs_tools, pytest.mark.slow]


def test_a_python_client_is_generated_without_a_warning(tmp_path: Path) -> None:
    words = ("--path", DOCUMENT, "--config", SETTINGS, "--output-path", tmp_path / "client", "--meta", "none")
    said = run("openapi-python-client", "generate", *words, "--fail-on-warning")
    assert "warning" not in said.lower()
    assert (tmp_path / "client" / "api" / "maps" / "create_map.py").exists()
    assert (tmp_path / "client" / "models" / "map_form.py").exists()


def test_types_for_typescript_are_generated_and_compile(tmp_path: Path) -> None:
    said = run("openapi-typescript", DOCUMENT, "-o", tmp_path / "spicd.ts")
    assert "warn" not in said.lower()
    run("tsc", "--strict", "--noEmit", tmp_path / "spicd.ts")
    written = (tmp_path / "spicd.ts").read_text()
    assert "scan_ids?: string[]" in written  # what has a default need not be sent
    assert "create_map: {" in written
