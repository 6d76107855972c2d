"""What is installed: pyproject.toml, the constraints, and the commands that check them."""

from __future__ import annotations

import re
import sys
import tomllib
from importlib.metadata import packages_distributions

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.test_imports import ROOT, read_imports, within

#: Imported only where a collector of traces is named (the extra `otel`), and where a recording is read (`ros`).
OPTIONAL = {"opentelemetry", "rosbags"}
BUNDLE = "web/built/*"  #: of the viewer, made where its packages can be had
#: Imported though another package is required, which hands them on as its own.
HANDED_ON = {
    "anyio": "fastapi",
    "pydantic-core": "pydantic",
    "starlette": "fastapi",
    "psycopg-binary": "psycopg",
}


def requirements(*extras: str) -> dict[str, Requirement]:
    """Canonical name to requirement, of the base install and of the extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [
        *project["dependencies"],
        *(line for e in extras for line in project["optional-dependencies"][e]),
    ]
    return {canonicalize_name(found.name): found for found in map(Requirement, lines)}


def pins() -> dict[str, str]:
    """Canonical name to version, from the constraints."""
    lines = (ROOT / "docker/constraints.txt").read_text().splitlines()
    pinned = [line.split("==") for line in lines if not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pinned}


def imported(package: str) -> set[str]:
    """Canonical names of the distributions whose modules `package` imports."""
    found = packages_distributions()
    tops = {
        other.partition(".")[0]
        for name, others in read_imports(ROOT).items()
        if within(name, (package,))
        for other in others
    }
    outside = tops - {"service", "worker", *OPTIONAL, *sys.stdlib_module_names}
    names = {canonicalize_name(found[top][0] if top in found else top) for top in outside}
    return {HANDED_ON.get(name, name) for name in names}


def test_the_base_install_is_what_the_service_imports() -> None:
    assert set(requirements()) == imported("service")


def test_the_worker_and_evaluate_extras_add_what_only_the_worker_imports() -> None:
    assert set(requirements("worker", "evaluate")) - set(requirements()) == imported("worker") - set(
        requirements()
    )


def test_every_requirement_is_pinned_to_a_version_that_it_admits() -> None:
    pinned = pins()
    wanted = requirements("worker", "evaluate", "otel", "ros", "dev")
    assert {name for name, needed in wanted.items() if not needed.specifier.contains(pinned[name])} == set()


def test_the_licence_is_named_as_pep_639_has_it_and_its_file_is_there() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == "MIT"
    assert project["authors"] == [{"name": "SPICD contributors"}]
    for name in project["license-files"]:
        assert "SPICD contributors" in (ROOT / name).read_text()


def test_the_hosted_ci_calls_the_commands_of_our_own_on_the_oldest_python() -> None:
    job = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]["all"]
    ours = [line for line in (ROOT / ".ci/run").read_text().splitlines() if line.startswith("make ")]
    assert [step["run"] for step in job["steps"] if step.get("run", "").startswith("make ")] == ours
    assert [line.split(" || ")[0] for line in ours] == [
        "make check",
        "make servers",
        "make browser",
        "make tools",
        "make web",
        "make test",
    ]
    oldest = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    (version,) = (step["with"]["python-version"] for step in job["steps"] if "python" in step.get("uses", ""))
    assert oldest == f">={version}"


def test_pre_commit_runs_what_make_check_runs() -> None:
    (repo,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert repo["repo"] == "local"  # nothing is fetched
    commands = [hook["entry"].replace(".venv/bin/", "$(BIN)/") for hook in repo["hooks"]]
    assert commands == recipe("check")
    assert {hook["language"] for hook in repo["hooks"]} == {"system"}
    assert not any(hook["pass_filenames"] for hook in repo["hooks"])


def recipe(target: str) -> list[str]:
    """Return the commands of a target of the Makefile."""
    rule = re.search(rf"^{target}:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert rule is not None
    return [line.strip() for line in rule[1].splitlines()]


def test_the_files_that_a_package_brings_beside_its_modules_are_there() -> None:
    brought = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert set(brought) == {"service", "worker"}
    assert brought["service"].count(BUNDLE) == 1
    for package, patterns in brought.items():
        for pattern in patterns:
            if pattern == BUNDLE and not (ROOT / "service/web/built").exists():
                continue  # `make web` makes it
            assert list((ROOT / package.replace(".", "/")).glob(pattern)), f"{package}: {pattern}"


def test_pins_are_plain_versions_of_the_public_releases() -> None:
    lines = (ROOT / "docker/constraints.txt").read_text().splitlines()
    odd = [line for line in lines if not re.fullmatch(r"#.*|[\w.-]+==\d[\w.]*", line)]
    assert odd == []
    assert pins()["torch"] == "2.13.0"
