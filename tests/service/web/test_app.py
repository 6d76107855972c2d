"""The page's logic, which needs no browser: its tests are TypeScript, and Node runs them as they are."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, get_args

import pytest

from service.api.openapi import written
from service.catalog.records import ObjectKind, ObjectStatus, ScanReason, TileState
from tests.support.tools import TOOLS

ROOT = Path(__file__).parents[3]
TESTS = Path(__file__).parent / "app"
SOURCE = ROOT / "service" / "web" / "source" / "app"


def node() -> str | None:
    """Return a Node that reads TypeScript (22.18 and later), as `make web` or `make tools` installed it."""
    places = (ROOT / "build" / "node" / "bin", TOOLS / "bin")
    return next((found for place in places if (found := shutil.which("node", path=str(place)))), None)


@pytest.mark.skipif(node() is None, reason="no Node on this machine: `make web` installs it")
@pytest.mark.parametrize("path", sorted(TESTS.glob("*.test.ts")), ids=lambda path: path.name.split(".")[0])
def test_the_logic_of_the_page(path: Path) -> None:
    command = [str(node()), "--test", "--test-timeout=30000", "--test-reporter=spec", str(path)]
    ended = subprocess.run(
        command,
        env={**os.environ, "TZ": "Europe/Berlin"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


INTERFACE = re.compile(r"^export interface (\w+)(?:<\w+>)?[^{]*\{\n(.*?)^\}", re.MULTILINE | re.DOTALL)
GENERIC = {"Feature", "Collection"}  #: one interface for what the API has of each kind


def test_documents_have_the_members_that_the_page_reads() -> None:
    schemas = json.loads(written())["components"]["schemas"]
    interfaces = INTERFACE.findall((SOURCE / "documents.ts").read_text())
    assert len(interfaces) > 20
    missing = [
        f"{name}.{member}"
        for name, body in interfaces
        for member in re.findall(r"^  (\w+)\??:", body, re.MULTILINE)
        if name not in GENERIC and not all(member in one["properties"] for one in forms(schemas, name))
    ]
    assert missing == []


def forms(schemas: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the schema of that name; of one with several forms, each of them."""
    references = [one["$ref"].rpartition("/")[2] for one in schemas[name].get("oneOf", ())]
    return [schemas[reference] for reference in references] or [schemas[name]]


@pytest.mark.parametrize(
    ("table", "known"),
    [("KINDS", ObjectKind), ("STATUSES", ObjectStatus), ("TILE_STATES", TileState), ("REASONS", ScanReason)],
)
def test_every_word_of_the_api_has_words_for_people(table: str, known: Any) -> None:
    text = (SOURCE / "words.ts").read_text()
    body = re.search(rf"export const {table}:.*?= \{{\n(.*?)^\}};", text, re.MULTILINE | re.DOTALL)
    assert body is not None
    assert set(get_args(known)) <= set(re.findall(r"^  (\w+):", body[1], re.MULTILINE))


def test_the_page_for_operators_has_every_key_and_every_member_of_a_link() -> None:
    page = (ROOT / "docs" / "viewer.md").read_text()
    keys = re.search(
        r"KEYS: [^=]*= \[\n(.*?)^\];", (SOURCE / "keys.ts").read_text(), re.MULTILINE | re.DOTALL
    )
    members = re.search(
        r"const words: [^=]*= \[\n(.*?)^  \];", (SOURCE / "link.ts").read_text(), re.MULTILINE | re.DOTALL
    )
    assert keys is not None
    assert members is not None
    pressed = [key for shown in re.findall(r'^  \["([^"]+)"', keys[1], re.MULTILINE) for key in shown.split()]
    named = re.findall(r'^    \["(\w+)"', members[1], re.MULTILINE)
    assert len(pressed) > 15
    assert len(named) > 10
    assert [one for one in [*pressed, *named, "tiles"] if f"`{one}`" not in page] == []
