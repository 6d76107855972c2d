"""How it is deployed: the images, the compose file, the manifests, alerts and board.

No engine of containers is needed: the files are held against their schemas, against the settings and commands that
they use, and against each other.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import promql_parser
import pytest
import yaml
from fastapi.testclient import TestClient

from service.catalog.tallies import FAULTS
from service.settings import Settings
from service.up.launcher import KEEP_ALIVE_S
from tests.support.samples import RememberingQueue, running, settings_in
from tests.test_imports import ROOT
from worker.__main__ import _parse

DOCKER = ROOT / "docker"
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
WORKERS = {
    "worker-geometry": "geometry",
    "worker-inference": "inference",
    "worker-inference-gpu": "inference",
}
OURS = ("service", *WORKERS)
ONCE = ("s3-bucket", "first-key")  #: they do one thing and end
STORES = ("redis", "postgres", "s3")
MANIFESTS = sorted((DOCKER / "kubernetes").glob("*.yaml"))
KUBERNETES = "1.37"

#: Variables that parts of the service read beside its settings, by who reads them.
FOREIGN = {
    "PGPASSWORD",  # libpq
    *(
        f"AWS_{name}"
        for name in ("ENDPOINT_URL", "ALLOW_HTTP", "REGION", "ACCESS_KEY_ID", "SECRET_ACCESS_KEY")
    ),  # obstore
    "OTEL_EXPORTER_OTLP_ENDPOINT",  # OpenTelemetry
}
OF_IMAGES = {"PATH", "TMPDIR", "MPLCONFIGDIR", "XDG_CACHE_HOME"}


@dataclass
class Stage:
    """A stage of the Dockerfile with what it has of the stages that it goes on from."""

    base: str
    lines: list[tuple[str, str]] = field(default_factory=list)

    def last(self, word: str) -> Any:
        """The words of the last CMD or ENTRYPOINT."""
        return json.loads([rest for name, rest in self.lines if name == word][-1])

    @property
    def environment(self) -> dict[str, str]:
        pairs = " ".join(rest for name, rest in self.lines if name == "ENV")
        return dict(word.split("=", 1) for word in pairs.split())


def stages() -> dict[str, Stage]:
    text = re.sub(r"^\s*#.*\n", "", (DOCKER / "Dockerfile").read_text(), flags=re.MULTILINE)
    found: dict[str, Stage] = {}
    stage = Stage("")
    for line in text.replace("\\\n", " ").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "FROM":
            base, _, name = rest.split()
            before = found.get(base)
            stage = found[name] = Stage(before.base if before else base, list(before.lines) if before else [])
        elif word:
            stage.lines.append((word, rest.strip()))
    return found


STAGES = stages()


def substituted(value: object) -> str:
    """A value as compose fills it in where nothing is set: `${NAME:-default}` takes its default."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", str(value))


def environment_of(name: str) -> dict[str, str]:
    """What a container of ours is started with; a secret's file gives its variable a value."""
    part = SERVICES[name]
    given = {key: substituted(value) for key, value in part["environment"].items()}
    return {**STAGES[part["build"]["target"]].environment, **given}


def read(environment: Mapping[str, str]) -> set[str]:
    """The variables that are read in the end."""
    return {name.removesuffix("_FILE") for name in environment} - OF_IMAGES


def is_known(name: str) -> bool:
    ours = {f"SPICD_{setting.upper()}" for setting in Settings.model_fields}
    return name in ours | FOREIGN or name.startswith(("PYTHON", "NVIDIA_"))


# The images


def test_the_base_is_pinned_and_given_once() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    (image,) = re.findall(r"^ARG PYTHON_IMAGE=(.+)$", text, re.MULTILINE)
    assert re.fullmatch(r"python:3\.11\.\d+-slim-bookworm", image)
    assert {stage.base for stage in STAGES.values()} == {"${PYTHON_IMAGE}"}


@pytest.mark.parametrize("target", ["service", "worker-cpu", "worker-cuda"])
def test_an_image_runs_as_nobody_special_through_the_entry_point(target: str) -> None:
    stage = STAGES[target]
    assert [rest for name, rest in stage.lines if name == "USER"] == ["10001:10001"]
    assert stage.last("ENTRYPOINT")[:2] == ["sh", "/app/docker/entrypoint.sh"]
    assert ("VOLUME", "/data") in stage.lines
    assert all(is_known(name) for name in stage.environment if name not in OF_IMAGES), stage.environment


def test_what_is_copied_is_there_and_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    kept = [line.removeprefix("!") for line in ignored if line.startswith("!")]
    assert "*" in ignored
    copied = [rest.split() for stage in STAGES.values() for name, rest in stage.lines if name == "COPY"]
    for words in copied:
        sources = [word for word in words[:-1] if not word.startswith("--")]
        if any(word.startswith("--from=") for word in words):
            continue
        for source in sources:
            assert (ROOT / source).exists(), source
            assert any(source == name or source.startswith(f"{name}/") for name in kept), source


def test_only_the_workers_images_have_the_worker_and_its_libraries() -> None:
    installs = {
        name: " ".join(rest for word, rest in STAGES[name].lines if word == "RUN")
        for name in ("build-service", "build-worker-cpu", "build-worker-cuda")
    }
    assert "[otel]" in installs["build-service"]
    assert all("[worker,otel]" in installs[name] for name in installs if name != "build-service")
    assert "download.pytorch.org/whl/cpu" in str(STAGES["build-worker-cpu"].lines)
    assert "--extra-index-url" not in installs["build-worker-cuda"]
    assert ("COPY", "worker worker") not in STAGES["build-service"].lines


def test_the_entry_point_reads_secrets_from_files_and_keeps_the_rest(tmp_path: Path) -> None:
    secret = tmp_path / "key"
    secret.write_text("s3cr$t `x`\n")
    environment = {
        "PATH": os.environ["PATH"],
        "PGPASSWORD_FILE": str(secret),
        "SSL_CERT_FILE": "/etc/ssl/certs.pem",  # no secret of ours
    }
    command = ["/bin/sh", str(DOCKER / "entrypoint.sh"), "env"]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found = dict(line.split("=", 1) for line in ran.stdout.splitlines())
    assert found["PGPASSWORD"] == "s3cr$t `x`"
    assert "PGPASSWORD_FILE" not in found
    assert found["SSL_CERT_FILE"] == "/etc/ssl/certs.pem"
    missing = {**environment, "PGPASSWORD_FILE": str(tmp_path / "none")}
    refused = subprocess.run(command, env=missing, capture_output=True, text=True, check=False)
    assert refused.returncode == 78
    assert "cannot be read" in refused.stderr


def test_secrets_are_made_once_and_for_nobody_elses_eyes(tmp_path: Path) -> None:
    folder = tmp_path / "secrets"
    for _ in range(2):
        made = subprocess.run(
            ["/bin/sh", str(DOCKER / "make-secrets.sh"), str(folder)],
            capture_output=True,
            text=True,
            check=True,
        )
    assert made.stdout == ""  # the second time
    assert folder.stat().st_mode & 0o777 == 0o700
    names = {Path(secret["file"]).name for secret in COMPOSE["secrets"].values()}
    assert {path.name for path in folder.iterdir()} == names
    keys = json.loads((folder / "s3.json").read_text())["identities"][0]["credentials"][0]
    assert keys["secretKey"] == (folder / "s3_secret_key").read_text()
    assert re.fullmatch(r"[0-9a-f]{48}", (folder / "postgres_password").read_text())
    assert re.fullmatch(r"spicd_[0-9a-f]{64}", (folder / "first_key").read_text())


# The compose file


def test_the_compose_file_is_one() -> None:
    schema = resources.files("check_jsonschema") / "builtin_schemas/vendor/compose-spec.json"
    jsonschema.validate(COMPOSE, json.loads(schema.read_text()))


@pytest.mark.parametrize("name", ["ci", "images"])
def test_a_workflow_of_the_hosted_ci_is_one(name: str) -> None:
    schema = resources.files("check_jsonschema") / "builtin_schemas/vendor/github-workflows.json"
    workflow = yaml.safe_load((ROOT / f".github/workflows/{name}.yml").read_text())
    workflow["on"] = workflow.pop(True)  # YAML 1.1 takes the word for a truth value
    jsonschema.validate(workflow, json.loads(schema.read_text()))


def test_the_hosted_ci_builds_every_image_and_reads_every_file() -> None:
    jobs = yaml.safe_load((ROOT / ".github/workflows/images.yml").read_text())["jobs"]
    targets = {name for name, stage in STAGES.items() if any(word == "USER" for word, _ in stage.lines)}
    assert set(jobs["build"]["strategy"]["matrix"]["target"]) == targets
    commands = " ".join(step.get("run", "") for job in jobs.values() for step in job["steps"])
    for image in (SERVICES["proxy"]["image"], "promtool", "hadolint", "compose.yaml --profile gpu config"):
        assert image in commands


def test_the_parts_of_the_compose_file_are_there_and_fit_together() -> None:
    assert set(SERVICES) == {"proxy", *OURS, *STORES, *ONCE}
    for part in SERVICES.values():
        assert set(part.get("depends_on", ())) <= set(SERVICES)
        assert set(part["networks"]) <= set(COMPOSE["networks"])
        assert set(part.get("secrets", ())) <= set(COMPOSE["secrets"])
        named = [volume.partition(":")[0] for volume in part.get("volumes", ()) if isinstance(volume, str)]
        assert {name for name in named if not name.startswith("./")} <= set(COMPOSE["volumes"])
        assert all((DOCKER / name).exists() for name in named if name.startswith("./"))


@pytest.mark.parametrize("name", SERVICES)
def test_every_container_is_hardened_and_pinned(name: str) -> None:
    part = SERVICES[name]
    assert part["read_only"] is True
    assert part["cap_drop"] == ["ALL"]
    assert part["security_opt"] == ["no-new-privileges:true"]
    assert re.search(r":\d+\.\d+(\.\d+)?(-[\w.]+)?$", part["image"]), part["image"]
    assert name in ONCE or part.get("healthcheck")
    assert name == "proxy" or "ports" not in part
    if name in OURS:
        assert part["user"] == "10001:10001"
        assert [entry.partition(":")[0] for entry in part["tmpfs"]] == [f"{os.sep}tmp"]


def test_no_secret_stands_in_the_file() -> None:
    for part in SERVICES.values():
        for name, value in part.get("environment", {}).items():
            assert name.endswith("_FILE") or not re.search("PASSWORD|SECRET|KEY_ID|TOKEN|HEADERS", name), name
            assert not re.search(r"://[^/@]*:[^/@]*@", str(value)), name  # a password in a URL


@pytest.mark.parametrize("name", OURS)
def test_each_container_gets_settings_that_are_read(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = environment_of(name)
    assert [variable for variable in read(environment) if not is_known(variable)] == []
    for key, value in environment.items():
        if key.startswith("SPICD_"):
            monkeypatch.setenv(key, value)
    settings = Settings()
    assert settings.redis_url == "redis://redis:6379/0"
    assert settings.resolved_database_url() == "postgresql://spicd@postgres:5432/spicd"
    assert settings.resolved_blob_url() == "s3://spicd/blobs"
    assert settings.log_format == "json"
    targets = {v["target"] if isinstance(v, dict) else v.split(":")[1] for v in SERVICES[name]["volumes"]}
    assert str(settings.data_dir.parent) in targets
    files = {value for key, value in environment.items() if key.endswith("_FILE")}
    assert files == {f"/run/secrets/{secret}" for secret in SERVICES[name]["secrets"]}


def test_every_container_of_ours_shares_one_queue_one_database_and_one_blob_store() -> None:
    shared = ("SPICD_REDIS_URL", "SPICD_DATABASE_URL", "SPICD_BLOB_URL", "AWS_ENDPOINT_URL")
    assert len({tuple(SERVICES[name]["environment"][key] for key in shared) for name in OURS}) == 1


@pytest.mark.parametrize(("name", "queue"), WORKERS.items())
def test_a_worker_container_starts_the_worker_of_its_queue_and_asks_it(name: str, queue: str) -> None:
    part = SERVICES[name]
    stage = STAGES[part["build"]["target"]]
    assert stage.last("ENTRYPOINT")[2:] == ["python", "-m", "worker"]
    options = _parse([str(word) for word in part["command"]])
    assert options.queue == queue
    assert options.grace < float(part["stop_grace_period"].removesuffix("s"))
    assert part["healthcheck"]["test"][-5:] == ["python", "-m", "worker", "alive", queue]


def test_the_first_key_is_made_before_the_service_starts() -> None:
    part = SERVICES["first-key"]
    assert SERVICES["service"]["depends_on"]["first-key"] == {"condition": "service_completed_successfully"}
    assert part["environment"] == COMPOSE["x-environment"]
    (init,) = DEPLOYMENTS["Deployment service"]["template"]["spec"]["initContainers"]
    for words, file in (
        (part["command"], "/run/secrets/first_key"),
        (init["args"], "/run/secrets/spicd/first_key"),
    ):
        assert words[:2] == ["sh", "-c"]
        assert words[2] == f"spicd keys add first --scope admin --secret-file {file} || true"
    assert "first_key" in part["secrets"]


def test_a_gpu_is_asked_for_by_its_profile_alone() -> None:
    asking = [name for name, part in SERVICES.items() if "deploy" in part]
    assert asking == ["worker-inference-gpu"]
    assert SERVICES["worker-inference-gpu"]["profiles"] == ["gpu"]
    assert environment_of("worker-inference-gpu")["SPICD_DEVICE"] == "cuda"
    assert environment_of("worker-inference")["SPICD_DEVICE"] == "cpu"


def test_the_service_container_serves_alone_needs_keys_and_says_how_it_is() -> None:
    environment = environment_of("service")
    assert environment["SPICD_GEOMETRY_WORKERS"] == environment["SPICD_INFERENCE_WORKERS"] == "0"
    assert environment["SPICD_AUTH"] == "required"
    assert STAGES["service"].last("CMD") == ["/opt/venv/bin/spicd", "up"]
    probe = f"127.0.0.1:{environment['SPICD_PORT']}/health/live"
    assert probe in str(SERVICES["service"]["healthcheck"]["test"])
    assert any(name == "HEALTHCHECK" and probe in rest for name, rest in STAGES["service"].lines)


def test_uploads_may_end_before_the_service_is_killed() -> None:
    part = SERVICES["service"]
    grace = int(environment_of("service")["SPICD_SHUTDOWN_GRACE_S"])
    assert 300 <= grace < int(part["stop_grace_period"].removesuffix("s")) - 5
    pod = DEPLOYMENTS["Deployment service"]["template"]["spec"]
    (sleep, seconds) = pod["containers"][0]["lifecycle"]["preStop"]["exec"]["command"]
    grace = int(OBJECTS["ConfigMap spicd-service"]["data"]["SPICD_SHUTDOWN_GRACE_S"])
    assert sleep == "sleep"
    assert 300 <= grace < pod["terminationGracePeriodSeconds"] - int(seconds) - 5


def test_the_proxy_takes_what_the_service_takes_and_hides_its_metrics() -> None:
    text = (DOCKER / "Caddyfile").read_text()
    (size,) = re.findall(r"max_size (\d+)GiB", text)
    assert int(size) * 1024**3 == Settings.model_fields["max_upload_bytes"].default
    (body, answer) = (int(re.findall(rf"{word} (\d+)h", text)[0]) * 3600 for word in ("read_body", "write"))
    assert answer > body >= Settings.model_fields["upload_timeout_s"].default
    (idle,) = re.findall(r"keepalive (\d+)s", text)
    assert int(idle) < KEEP_ALIVE_S
    assert "reverse_proxy service:8000" in text
    assert re.search(r"handle /metrics \{\s*respond 404", text)
    assert text.count("{") == text.count("}")


# The manifests


def documents() -> Iterator[tuple[str, dict[str, Any]]]:
    for path in MANIFESTS:
        for document in yaml.safe_load_all(path.read_text()):
            yield f"{document['kind']} {document['metadata']['name']}", document


OBJECTS = dict(documents())
DEPLOYMENTS = {name: one["spec"] for name, one in OBJECTS.items() if one["kind"] == "Deployment"}


@pytest.mark.parametrize("name", OBJECTS)
def test_a_manifest_is_what_kubernetes_takes(name: str) -> None:
    kubernetes_validate.validate(OBJECTS[name], KUBERNETES, strict=True)


def test_the_manifests_have_what_a_deployment_needs() -> None:
    assert {one["kind"] for one in OBJECTS.values()} >= {
        "Namespace",
        "Deployment",
        "Service",
        "HorizontalPodAutoscaler",
        "PodDisruptionBudget",
        "NetworkPolicy",
        "ConfigMap",
        "Ingress",
    }
    assert set(DEPLOYMENTS) == {
        "Deployment service",
        "Deployment worker-geometry",
        "Deployment worker-inference",
    }
    spaces = {one["metadata"].get("namespace") for one in OBJECTS.values() if one["kind"] != "Namespace"}
    assert spaces == {"spicd"}


@pytest.mark.parametrize("name", DEPLOYMENTS)
def test_a_deployment_is_probed_limited_and_hardened(name: str) -> None:
    spec = DEPLOYMENTS[name]
    assert spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"]
    pod = spec["template"]["spec"]
    assert pod["automountServiceAccountToken"] is False
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    (container,) = pod["containers"]
    for each in (container, *pod.get("initContainers", ())):
        assert each["securityContext"] == {
            "readOnlyRootFilesystem": True,
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": ["ALL"]},
        }
        assert each["volumeMounts"] == container["volumeMounts"]
    assert {"startupProbe", "livenessProbe"} <= set(container)
    assert set(container["resources"]["requests"]) >= {"cpu", "memory"}
    assert "memory" in container["resources"]["limits"]
    mounted = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert {volume["name"] for volume in pod["volumes"]} == set(mounted)
    assert mounted["data"] == "/data"
    assert container["image"] in {part["image"] for part in SERVICES.values()}
    for source in container["envFrom"]:
        data = OBJECTS[f"ConfigMap {source['configMapRef']['name']}"]["data"]
        assert [key for key in read(data) if not is_known(key)] == []
        files = [value for key, value in data.items() if key.endswith("_FILE")]
        assert all(path.startswith(mounted["secrets"] + "/") for path in files)


@pytest.mark.parametrize("queue", ["geometry", "inference"])
def test_a_worker_pod_starts_the_worker_of_its_queue_and_asks_it(queue: str) -> None:
    pod = DEPLOYMENTS[f"Deployment worker-{queue}"]["template"]["spec"]
    (container,) = pod["containers"]
    options = _parse(container["args"])
    assert options.queue == queue
    assert options.grace < pod["terminationGracePeriodSeconds"]
    for probe in ("startupProbe", "livenessProbe"):
        assert container[probe]["exec"]["command"][-5:] == ["python", "-m", "worker", "alive", queue]


def test_what_names_a_deployment_names_one_that_is_there() -> None:
    scaled = OBJECTS["HorizontalPodAutoscaler worker-geometry"]["spec"]["scaleTargetRef"]
    assert f"{scaled['kind']} {scaled['name']}" in DEPLOYMENTS
    assert "replicas" not in DEPLOYMENTS["Deployment worker-geometry"]  # the scaler's
    labels = [spec["selector"]["matchLabels"] for spec in DEPLOYMENTS.values()]
    for one in OBJECTS.values():
        if one["kind"] == "PodDisruptionBudget":
            assert one["spec"]["selector"]["matchLabels"] in labels
        if one["kind"] == "NetworkPolicy":
            wanted = one["spec"]["podSelector"].get("matchLabels", {})
            assert any(wanted.items() <= of.items() for of in labels)
    assert OBJECTS["Service service"]["spec"]["selector"] in labels


def test_prometheus_brings_the_key_that_metrics_take() -> None:
    (job,) = yaml.safe_load((DOCKER / "monitoring/prometheus.yaml").read_text())["scrape_configs"]
    assert job["authorization"]["credentials_file"]
    for spec in DEPLOYMENTS.values():  # they would have it asked without one: 401
        assert "prometheus.io/scrape" not in spec["template"]["metadata"].get("annotations", {})


# Copies

BACKUP = (ROOT / "docs/backup.md").read_text()


def test_the_job_that_takes_a_copy_is_one_and_has_what_the_service_has() -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", BACKUP, re.DOTALL)
    job = yaml.safe_load(text)
    kubernetes_validate.validate(job, KUBERNETES, strict=True)
    pod, service = job["spec"]["template"]["spec"], DEPLOYMENTS["Deployment service"]["template"]["spec"]
    (container,), (of_service,) = pod["containers"], service["containers"]
    assert pod["securityContext"] == service["securityContext"]
    assert [container[name] for name in ("image", "securityContext")] == [
        of_service[name] for name in ("image", "securityContext")
    ]
    assert container["envFrom"][0] in of_service["envFrom"]
    assert all(mount in container["volumeMounts"] for mount in of_service["volumeMounts"])
    labels = job["spec"]["template"]["metadata"]["labels"]
    assert labels.items() >= OBJECTS["NetworkPolicy stores"]["spec"]["podSelector"]["matchLabels"].items()


def test_the_commands_that_copy_in_containers_name_services_and_folders_that_are_there() -> None:
    ran = re.findall(r"run --rm --no-deps --volume \S+:(\S+) (\S+) \\\n +spicd (\w+) (\S+)", BACKUP)
    assert [command for _, _, command, _ in ran] == ["backup", "restore"]
    for mounted, service, _, folder in ran:
        assert service in OURS
        assert folder.startswith(f"{mounted}/")


# What is watched

RULES = [
    rule
    for group in yaml.safe_load((DOCKER / "monitoring/alerts.yaml").read_text())["groups"]
    for rule in group["rules"]
]
BOARD: dict[str, Any] = json.loads((DOCKER / "monitoring/board.json").read_text())
EXPRESSIONS = {
    **{f"alert {rule['alert']}": rule["expr"] for rule in RULES},
    **{
        f"board {panel['title']} {target['refId']}": target["expr"]
        for panel in BOARD["panels"]
        for target in panel["targets"]
    },
}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as opened:
        yield opened


def told(client: TestClient) -> dict[str, set[str]]:
    """The metrics that the API tells, each with the names that its samples may have."""
    families = re.findall(r"^# TYPE (\w+) (\w+)$", client.get("/metrics").text, re.MULTILINE)
    endings = {"counter": ("",), "gauge": ("",), "summary": ("_count", "_sum")}
    endings["histogram"] = ("_count", "_sum", "_bucket")
    return {name: {name + ending for ending in endings[kind]} for name, kind in families}


def selectors(expression: str) -> Iterator[promql_parser.VectorSelector]:
    """The metrics that an expression asks for."""
    found: list[promql_parser.VectorSelector] = []

    def note(node: Any) -> bool:
        if isinstance(node, promql_parser.VectorSelector):
            found.append(node)
        return True

    promql_parser.walk(promql_parser.parse(expression), note)
    yield from found


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_what_is_asked_of_prometheus_is_told_by_the_service(name: str, client: TestClient) -> None:
    names = {sample for samples in told(client).values() for sample in samples} | {"up"}
    asked = {selector.name for selector in selectors(EXPRESSIONS[name])}
    assert asked
    assert asked <= names


def test_every_metric_of_the_service_is_on_the_board(client: TestClient) -> None:
    asked = {selector.name for name, text in EXPRESSIONS.items() for selector in selectors(text)}
    ours = {name: samples for name, samples in told(client).items() if not name.endswith("_created")}
    assert [name for name, samples in ours.items() if not samples & asked] == []


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: str(rule["alert"]))
def test_an_alert_says_what_to_do(rule: dict[str, Any]) -> None:
    assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
    assert rule["labels"]["severity"] in {"page", "ticket"}
    page, _, anchor = rule["annotations"]["runbook"].partition("#")
    headings = re.findall(r"^#+ (.+)$", (ROOT / page).read_text(), re.MULTILINE)
    assert anchor in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    shown = re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])
    grouped = re.findall(r"by \(([^)]*)\)", rule["expr"])
    if grouped:
        assert set(shown) <= {label.strip() for group in grouped for label in group.split(",")}


def test_the_faults_that_somebody_is_called_for_are_told_before_they_happen() -> None:
    (rule,) = [rule for rule in RULES if rule["alert"] == "SpicdJobsFail"]
    assert f'outcome=~"{"|".join(FAULTS)}"' in rule["expr"]


def test_the_board_has_a_panel_in_each_place() -> None:
    places = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in BOARD["panels"]]
    assert len(set(places)) == len(places)
    assert len({panel["id"] for panel in BOARD["panels"]}) == len(places)
    (source,) = BOARD["templating"]["list"]
    assert all(panel["datasource"]["uid"] == f"${{{source['name']}}}" for panel in BOARD["panels"])
