"""Clients that generators of other people make of the OpenAPI document, without a warning."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.support.tools import ROOT, TOOLS, needs_tools, run

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


#: What a dashboard relies on beside the lines in the head of the document: one type for each answer and each event.
DASHBOARD = """
const { data: changes } = await features.GET("/maps/{map_id}/changes", { params: { path: { map_id: "lobby" } } });
const scores: (number | null)[] = (changes?.features ?? []).map((change) => change.properties.max_score);
const cursor: string | undefined = changes?.cursor;
const { data: told } = await api.GET("/events", { params: { query: { wait: 20 } } });
for (const event of told?.events ?? []) {
  if (event.type === "change.told") {
    const id: string = event.data.change_id;
  } else if (event.type === "survey.ready" || event.type === "survey.failed") {
    const counts: { [state: string]: number } = event.data.counts;
  }
}
function received(event: webhooks["event"]["post"]["requestBody"]["content"]["application/cloudevents+json"]): string {
  return event.type === "webhook.ping" ? event.data.webhook_id : event.sequence;
}
const { data: listing } = await api.GET("/maps/{map_id}/manifest", { params: { path: { map_id: "lobby" } } });
const tiles: string[] = (listing?.patches ?? []).map((tile) => tile.patch_id);
"""


def test_the_lines_in_the_head_of_the_document_compile(tmp_path: Path) -> None:
    run("openapi-typescript", DOCUMENT, "-o", tmp_path / "spicd.ts")
    head = json.loads(DOCUMENT.read_text())["info"]["description"]
    lines = re.findall(r"^```ts\n(.*?)^```", head, re.MULTILINE | re.DOTALL)
    assert len(lines) == 2
    given = 'import createClient from "openapi-fetch";\nimport type { paths, webhooks } from "./spicd.js";\n'
    given += "declare const baseUrl: string;\ndeclare const file: Blob;\n"
    (tmp_path / "head.ts").write_text(given + "".join(lines) + DASHBOARD)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "node_modules").symlink_to(TOOLS / "node_modules")
    words = ("--strict", "--noEmit", "--target", "es2022", "--module", "nodenext", "--lib", "es2022,dom")
    run("tsc", *words, "head.ts", cwd=tmp_path)
