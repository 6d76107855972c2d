"""Who may import whom (docs/architecture.md), read from the source: imports inside functions count as well."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from worker.detectors.registry import DETECTORS

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("service", "worker")

Imports = Mapping[
    str, frozenset[str]
]  #: module -> dotted names it imports, those of our own as far as modules go

#: The rooms, and what each may import of our own code beside itself; a row that is missing fails a test.
#: The rows are in order: a room imports from rows above its own, never from below.
ROOMS: dict[str, tuple[str, ...]] = {
    "service.errors": (),
    "service.settings": (),
    "service.logs": (),
    "service.tracing": (),
    "service.permissions": (),
    "service.poses": (),
    "service.resumable": (),
    "service.client": ("service.resumable",),
    "service.robots": ("service.client", "service.resumable", "service.poses"),
    "service.tile_features": (),
    "service.object_features": ("service.tile_features",),
    "service.catalog": ("service.errors", "service.settings"),
    "service.cloud_events": ("service.catalog",),
    "service.webhooks": ("service.cloud_events", "service.catalog", "service.errors"),
    "service.queue": ("service.catalog.steps", "service.errors"),
    "service.dispatch": ("service.catalog", "service.queue", "service.errors"),
    "service.api.http": (
        "service.dispatch",
        "service.queue",
        "service.catalog",
        "service.errors",
        "service.logs",
        "service.poses",
        "service.tracing",
        "service.settings",
    ),
    "service.web": ("service.api.http", "service.errors"),
    "service.api": (
        "service.api.http",
        "service.web",
        "service.catalog",
        "service.cloud_events",
        "service.webhooks",
        "service.tile_features",
        "service.object_features",
        "service.dispatch",
        "service.queue",
        "service.errors",
        "service.settings",
    ),
    "service.up": (
        "service.api",
        "service.catalog",
        "service.dispatch",
        "service.queue",
        "service.permissions",
        "service.settings",
        "service.logs",
        "service.errors",
    ),
    "service.cli": (
        "service.up",
        "service.catalog",
        "service.client",
        "service.robots",
        "service.resumable",
        "service.poses",
        "service.permissions",
        "service.settings",
        "service.logs",
        "service.errors",
    ),
    "service.__main__": ("service.cli",),
    "worker.errors": (),
    "worker.files": (),
    "worker.progress": (),
    "worker.threads": (),
    "worker.memory": ("worker.errors",),
    "worker.processes": ("worker.errors", "worker.threads"),
    "worker.reporting": ("worker.errors",),
    "worker.cloud": ("worker.errors", "worker.files", "worker.threads"),
    "worker.metrics": ("worker.cloud",),
    "worker.detectors": (
        "worker.cloud",
        "worker.errors",
        "worker.files",
        "worker.progress",
        "worker.threads",
    ),
    "worker.pipeline.registration": (
        "worker.cloud",
        "worker.errors",
        "worker.files",
        "worker.progress",
        "worker.threads",
    ),
    "worker.pipeline.placement": (
        "worker.pipeline.registration",
        "worker.cloud",
        "worker.errors",
        "worker.threads",
    ),
    "worker.pipeline.mapping": (
        "worker.pipeline.placement",
        "worker.pipeline.registration",
        "worker.cloud",
        "worker.errors",
        "worker.progress",
        "worker.processes",
    ),
    "worker.pipeline.results": (
        "worker.pipeline.mapping",
        "worker.detectors",
        "worker.cloud",
        "worker.errors",
        "worker.files",
    ),
    "worker.pipeline": (
        "worker.detectors",
        "worker.cloud",
        "worker.errors",
        "worker.files",
        "worker.progress",
        "worker.processes",
    ),
    "worker.training": (
        "worker.detectors",
        "worker.cloud",
        "worker.metrics",
        "worker.errors",
        "worker.files",
        "worker.progress",
    ),
    "worker.scratch": (),
    "worker.watch": (),
    "worker.rq_jobs": ("service.queue",),
    "worker.rq_threads": (),
    "worker.endings": ("service.errors", "worker.rq_jobs", "worker.errors"),
    "worker.rq_workers": (
        "service.logs",
        "service.errors",
        "service.settings",
        "service.up.lifetime",
        "worker.rq_jobs",
        "worker.rq_threads",
        "worker.endings",
        "worker.memory",
        "worker.errors",
        "worker.watch",
    ),
    "worker.jobs": (
        "service.catalog",
        "service.errors",
        "service.settings",
        "service.tracing",
        "worker.scratch",
        "worker.pipeline",
        "worker.training",
        "worker.detectors",
        "worker.cloud",
        "worker.reporting",
        "worker.memory",
        "worker.errors",
        "worker.progress",
    ),
    "worker.__main__": (
        "service.errors",
        "service.catalog",
        "service.settings",
        "service.logs",
        "service.permissions",
        "service.up.embedded_redis",
        "service.up.lifetime",
        "service.up.requirements",
        "service.dispatch",
        "service.queue",
        "worker.scratch",
        "worker.jobs",
        "worker.memory",
        "worker.rq_workers",
        "worker.threads",
    ),
    "worker.simulation": (
        "worker.training",
        "worker.detectors",
        "worker.cloud",
        "worker.processes",
        "worker.errors",
        "worker.files",
        "worker.progress",
    ),
    "worker.benchmarks": (
        "worker.simulation",
        "worker.training",
        "worker.pipeline",
        "worker.detectors",
        "worker.cloud",
        "worker.metrics",
        "worker.errors",
        "worker.files",
        "worker.progress",
        "worker.processes",
        "worker.threads",
    ),
    # the demo is a client of the service like any other
    "worker.demo": (
        "service.client",
        "worker.simulation",
        "worker.benchmarks",
        "worker.pipeline",
        "worker.detectors",
        "worker.cloud",
        "worker.errors",
        "worker.progress",
    ),
    "worker.cli": (
        "service.tile_features",
        "service.object_features",
        "worker.demo",
        "worker.benchmarks",
        "worker.simulation",
        "worker.training",
        "worker.pipeline",
        "worker.detectors",
        "worker.cloud",
        "worker.errors",
        "worker.files",
        "worker.progress",
        "worker.threads",
    ),
}

#: Third-party packages that have their places, and nobody else imports.
ONLY_IN = {
    "rq": ("service.queue", "worker.__main__", "worker.jobs", "worker.rq_jobs", "worker.rq_workers"),
    "redis": ("service.queue", "service.up", "worker.__main__", "worker.rq_workers"),
    "open3d": ("worker.cloud", "worker.pipeline", "worker.simulation", "worker.benchmarks"),
    "torch": ("worker.detectors", "worker.training", "worker.benchmarks", "worker.cli"),
    "sqlalchemy": ("service.catalog",),
    "obstore": ("service.catalog",),
    "fastapi": ("service.api", "service.up", "service.web"),
    "opentelemetry": ("service.tracing",),
    "rosbags": ("service.robots.bags",),
    "httpcore": ("service.webhooks",),
    "standardwebhooks": ("service.webhooks",),
}

#: The files of the worker that know the service; the demo and the rest are in ROOMS.
KNOWS_THE_SERVICE = (
    "worker.__main__",
    "worker.jobs",
    "worker.endings",
    "worker.rq_jobs",
    "worker.rq_workers",
    "worker.demo",
    "worker.cli.compare",
)

TRAINING_NEEDS = {"torch", "numpy"}
OPTIONAL_FOR_TRAINING = {"fpsample", "scipy"}  #: imported in a `try`; there is a slower way without

#: Modules that the table of detectors names in words, so that no import statement shows them.
NETWORKS = {entry.network.partition(":")[0] for entry in DETECTORS.values() if entry.network is not None}
NAMED = NETWORKS | {entry.detector.partition(":")[0] for entry in DETECTORS.values()}
TRAINING = ("worker.training.__main__", *sorted(NETWORKS))


@pytest.fixture(scope="module")
def imports() -> Imports:
    return read_imports(ROOT)


def test_each_part_imports_what_stands_below_it_and_nothing_else(imports: Imports) -> None:
    assert against_layers(imports) == []


def test_a_room_names_rooms_above_its_own_alone() -> None:
    order = list(ROOMS)
    for room, allowed in ROOMS.items():
        for other in allowed:
            above = [name for name in order[: order.index(room)] if within(other, (name,))]
            assert above or within(room, (other,)), f"{room} may import {other}, which stands below it"


def test_the_service_imports_nothing_of_the_worker_and_none_of_its_libraries(imports: Imports) -> None:
    assert in_the_service(imports) == []


@pytest.mark.parametrize("package", ONLY_IN)
def test_a_library_with_its_places_is_imported_nowhere_else(imports: Imports, package: str) -> None:
    assert outside(imports, package, ONLY_IN[package]) == []


def test_only_the_shell_of_the_worker_knows_the_service(imports: Imports) -> None:
    worker = {name: found for name, found in imports.items() if within(name, ("worker",))}
    assert outside(worker, "service", KNOWS_THE_SERVICE) == []


@pytest.mark.parametrize("name", TRAINING)
def test_training_runs_where_there_is_only_torch_and_numpy(imports: Imports, name: str) -> None:
    assert third_party(reached(imports, name)) <= TRAINING_NEEDS | OPTIONAL_FOR_TRAINING


@pytest.mark.parametrize("name", sorted(NAMED))
def test_a_detector_that_is_named_lies_in_the_room_of_detectors(imports: Imports, name: str) -> None:
    assert name in imports
    assert name.startswith("worker.detectors.")


def test_no_modules_import_each_other_in_a_circle(imports: Imports) -> None:
    assert circle(imports) is None


@pytest.mark.parametrize(
    ("path", "line"),
    [
        ("service/api/maps.py", "from worker.pipeline import flow"),
        ("service/catalog/maps.py", "def f():\n    import torch"),
        ("service/cli/up.py", "import numpy.linalg"),
        ("service/catalog/maps.py", "from service.api import maps"),
        ("service/api/http/answering/paging.py", "def f():\n    from service.api import maps"),
        ("service/catalog/jobs.py", "from rq import Queue"),
        ("service/client/errors.py", "from service import errors"),
        ("worker/pipeline/flow.py", "from service.catalog.jobs import Jobs"),
        ("worker/pipeline/flow.py", "from redis import Redis"),
        ("worker/pipeline/flow.py", "from .. import jobs"),
        ("worker/pipeline/flow.py", "import importlib\nimportlib.import_module('worker.jobs')"),
        ("worker/detectors/store.py", "from worker.pipeline.registration.scan_to_map import register"),
        ("worker/detectors/store.py", "from worker.pipeline import icp"),
        ("worker/detectors/store.py", "import open3d as o3d"),
        ("worker/training/trainer.py", "from worker.simulation import sensor"),
        ("worker/training/trainer.py", "import pandas"),
        ("worker/cloud/patches.py", "import matplotlib"),  # training reaches it
        ("worker/simulation/sensor.py", "import worker.jobs"),
        ("worker/pipeline/registration/icp.py", "from worker.pipeline.mapping import fusion"),
        ("worker/pipeline/mapping/fusion.py", "def f():\n    from worker.pipeline import flow"),
        ("worker/jobs/maps.py", "from worker.simulation import sensor"),
        ("worker/training/publish.py", "from worker.benchmarks import speed"),
        ("worker/cloud/tiling.py", "from worker.detectors.card import Card"),
        ("worker/elsewhere.py", "import json"),
        ("worker/demo/extra.py", "from service.catalog.catalog import open_catalog"),
    ],
)
def test_a_forbidden_import_is_found(imports: Imports, path: str, line: str) -> None:
    assert set(violations(with_line(imports, path, line))) - set(violations(imports))


@pytest.mark.parametrize(
    "line", ["from worker.cloud import tiling", "def f():\n    from worker.cloud import tiling"]
)
def test_a_circle_is_found(imports: Imports, line: str) -> None:
    assert circle(with_line(imports, "worker/cloud/types.py", line))  # tiling imports types


def with_line(imports: Imports, path: str, line: str) -> Imports:
    """`imports` as they would be with `line` in the file at `path`."""
    name = module_name(Path(path))
    added = imports_of(line, name, is_package=False, modules={*imports, name})
    return {**imports, name: imports.get(name, frozenset()) | added}


def violations(imports: Imports) -> list[str]:
    """What the tests above would complain of, circles apart."""
    training = set().union(*(third_party(reached(imports, name)) for name in TRAINING))
    training -= TRAINING_NEEDS | OPTIONAL_FOR_TRAINING
    return [
        *against_layers(imports),
        *in_the_service(imports),
        *(each for package, places in ONLY_IN.items() for each in outside(imports, package, places)),
        *(f"training reaches {package}" for package in sorted(training)),
    ]


def against_layers(imports: Imports) -> list[str]:
    """`module imports other` for each import that ROOMS does not name, and each module that has no room."""
    found = [f"{name} has no room" for name in imports if name not in PACKAGES and room_of(name) is None]
    for name, others in imports.items():
        room = room_of(name)
        allowed = () if room is None else (room, *ROOMS[room])
        found += [
            f"{name} imports {other}"
            for other in sorted(others)
            if within(other, PACKAGES) and not within(other, allowed)
        ]
    return found


def room_of(name: str) -> str | None:
    """The innermost room that a module lies in."""
    return max((room for room in ROOMS if within(name, (room,))), key=len, default=None)


def in_the_service(imports: Imports) -> list[str]:
    """The base install carries none of these."""
    heavy = ("worker", "torch", "open3d", "numpy", "scipy", "matplotlib", "safetensors", "imagecodecs")
    return [
        f"{name} imports {other}"
        for name, found in imports.items()
        if within(name, ("service",))
        for other in sorted(found)
        if within(other, heavy)
    ]


def outside(imports: Imports, package: str, places: tuple[str, ...]) -> list[str]:
    """Modules that import `package` and are not in one of its places."""
    return [
        f"{name} imports {package}"
        for name, found in imports.items()
        if not within(name, places) and any(within(other, (package,)) for other in found)
    ]


def reached(imports: Imports, part: str) -> set[str]:
    """Everything that is imported, directly or not, when the modules of `part` are."""
    waiting = [name for name in imports if within(name, (part,))]
    seen: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting += imports.get(name, ())
    return seen


def third_party(names: set[str]) -> set[str]:
    """The packages among `names` that are neither ours nor Python's."""
    return {name.partition(".")[0] for name in names} - {*PACKAGES, *sys.stdlib_module_names}


def circle(imports: Imports) -> list[str] | None:
    """Return modules that import each other in a circle, inside functions too; a package and its parts do not count."""
    graph = {
        name: {other for other in found if other in imports and not within(name, (other,))}
        for name, found in imports.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return None


def within(name: str, parts: tuple[str, ...]) -> bool:
    """Whether a dotted name is one of `parts` or lies in it."""
    return any(name == part or name.startswith(part + ".") for part in parts)


def read_imports(root: Path) -> Imports:
    """Every import of every module of our packages under `root`."""
    files = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    modules = {module_name(path.relative_to(root)) for path in files}
    return {
        (name := module_name(path.relative_to(root))): imports_of(
            path.read_text(),
            name,
            is_package=path.name == "__init__.py",
            modules=modules,
        )
        for path in files
    }


def module_name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(source: str, module: str, *, is_package: bool, modules: set[str]) -> frozenset[str]:
    """The dotted names that the source of `module` imports, wherever in it."""
    nodes = ast.walk(ast.parse(source))
    return frozenset(name for node in nodes for name in _named(node, module, is_package, modules))


def _named(node: ast.AST, module: str, is_package: bool, modules: set[str]) -> Iterator[str]:
    match node:
        case ast.Import():
            yield from (alias.name for alias in node.names)
        case ast.ImportFrom():
            base = node.module or ""
            if node.level:
                above = module.split(".")
                above = above[: len(above) - node.level + is_package]
                base = ".".join([*above, base] if base else above)
            for alias in node.names:  # `from package import module` names the module
                whole = f"{base}.{alias.name}"
                yield whole if whole in modules else base
        case ast.Call(func=ast.Attribute(attr="import_module"), args=[ast.Constant(value=str(name)), *_]):
            yield name
