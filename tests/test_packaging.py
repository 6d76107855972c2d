"""What is installed and how it is deployed: pyproject.toml, the constraints, the images and the compose file."""

from __future__ import annotations

import fnmatch
import json
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from service.settings import Settings
from tests.test_imports import ROOT, read_imports, within
from worker.__main__ import _parse

#: Imported though another package is required, which hands them on as its own.
HANDED_ON = {
    "anyio": "fastapi",
    "pydantic-core": "pydantic",
    "starlette": "fastapi",
    "psycopg-binary": "psycopg",
}

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker/compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OURS = ("service", "worker-geometry", "worker-inference")
DOCKERFILES = sorted((ROOT / "docker").glob("Dockerfile.*"))


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
    outside = tops - {"service", "worker", *sys.stdlib_module_names}
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
    wanted = requirements("worker", "evaluate", "dev")
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
    assert ours == ["make check", "make test"]
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
    for package, patterns in brought.items():
        for pattern in patterns:
            assert list((ROOT / package.replace(".", "/")).glob(pattern)), f"{package}: {pattern}"


def test_pins_are_plain_versions_of_the_public_releases() -> None:
    lines = (ROOT / "docker/constraints.txt").read_text().splitlines()
    odd = [line for line in lines if not re.fullmatch(r"#.*|[\w.-]+==\d[\w.]*", line)]
    assert odd == []
    assert pins()["torch"] == "2.13.0"


def test_the_parts_of_the_compose_file_are_there() -> None:
    assert set(SERVICES) == {"redis", "postgres", *OURS}
    for part in SERVICES.values():
        assert set(part.get("depends_on", ())) <= set(SERVICES)
        mounted = {volume.partition(":")[0] for volume in part["volumes"]}
        assert mounted <= set(COMPOSE["volumes"])


@pytest.mark.parametrize("name", OURS)
def test_each_container_gets_settings_that_the_service_reads(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {key: substituted(value) for key, value in SERVICES[name]["environment"].items()}
    assert set(environment) <= {f"SPICD_{field.upper()}" for field in Settings.model_fields}
    for key, value in {**image_environment(name), **environment}.items():
        if key.startswith("SPICD_"):
            monkeypatch.setenv(key, value)
    settings = Settings()
    assert settings.redis_url == "redis://redis:6379/0"
    assert settings.resolved_database_url() == "postgresql://spicd:secret@postgres:5432/spicd"
    assert settings.resolved_blob_url().startswith(f"file://{settings.data_dir}/")  # in the shared volume
    assert f"{settings.data_dir}" in {volume.partition(":")[2] for volume in SERVICES[name]["volumes"]}


def test_every_container_of_ours_shares_one_queue_one_database_and_one_blob_store() -> None:
    shared = ("SPICD_REDIS_URL", "SPICD_DATABASE_URL", "SPICD_BLOB_URL")
    assert len({tuple(SERVICES[name]["environment"][key] for key in shared) for name in OURS}) == 1


@pytest.mark.parametrize("queue", ["geometry", "inference"])
def test_a_worker_container_starts_the_worker_of_its_queue(queue: str) -> None:
    part = SERVICES[f"worker-{queue}"]
    options = _parse([str(word) for word in part["command"]])
    assert options.queue == queue
    assert options.grace < float(part["stop_grace_period"].removesuffix("s"))
    assert instruction(part, "ENTRYPOINT") == ["python", "-m", "worker"]


def test_the_service_container_serves_alone_and_says_how_it_is() -> None:
    environment = image_environment("service")
    assert environment["SPICD_GEOMETRY_WORKERS"] == environment["SPICD_INFERENCE_WORKERS"] == "0"
    assert instruction(SERVICES["service"], "CMD") == ["spicd", "up"]
    assert f":{environment['SPICD_PORT']}/health/live" in dockerfile(SERVICES["service"])
    assert all(SERVICES[name].get("healthcheck") for name in ("redis", "postgres"))


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_copies_what_is_there_and_not_ignored_and_runs_as_nobody_special(path: Path) -> None:
    text = path.read_text()
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    kept = [line.removeprefix("!") for line in ignored if line.startswith("!")]
    assert "*" in ignored
    for line in re.findall(r"^COPY (.+) \S+$", text, re.MULTILINE):
        for source in line.split():
            assert (ROOT / source).exists(), source
            assert any(source == name or source.startswith(f"{name}/") for name in kept), source
    assert re.findall(r"^USER (\S+)$", text, re.MULTILINE) == ["spicd"]


def test_only_the_workers_image_installs_the_workers_libraries() -> None:
    assert "[worker]" in dockerfile(SERVICES["worker-geometry"])
    assert "[worker]" not in dockerfile(SERVICES["service"])
    assert not any(
        fnmatch.fnmatch(line, "COPY worker *") for line in dockerfile(SERVICES["service"]).splitlines()
    )


def dockerfile(part: dict[str, Any]) -> str:
    return (ROOT / part["build"]["dockerfile"]).read_text()


def instruction(part: dict[str, Any], name: str) -> list[str]:
    """The words of a CMD or ENTRYPOINT in JSON form."""
    found = re.findall(rf"^{name} (\[.*\])$", dockerfile(part), re.MULTILINE)
    return list(json.loads(found[-1]))


def image_environment(name: str) -> dict[str, str]:
    """What the ENV lines of a container's image set."""
    text = dockerfile(SERVICES[name]).replace("\\\n", " ")
    lines = re.findall(r"^ENV (.+)$", text, re.MULTILINE)
    return dict(word.split("=", 1) for line in lines for word in line.split())


def substituted(value: object) -> str:
    """A value as compose fills it in: `${NAME:-default}` takes its default, `${NAME:?...}` the word secret."""
    filled = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", str(value))
    return re.sub(r"\$\{\w+:\?[^}]*\}", "secret", filled)
