"""Measure the floor plan: files, lines and imports by room, lengths of functions, and the modules of one survey.

`python -m tests.support.floor_plan [ROOT]` prints tables for the checkout at ROOT, this one if left out.
`python -m tests.support.floor_plan --survey` counts the modules that run between the POST of a survey and its results.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import statistics
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = ("service", "worker")
JOB = "job"


def main() -> None:
    """Print the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).resolve().parents[2])
    parser.add_argument(
        "--survey", action="store_true", help="run one survey and count the modules it crosses"
    )
    given = parser.parse_args()
    if given.survey:
        _print_survey()
    else:
        _print_rooms(given.root.resolve())


def _print_rooms(root: Path) -> None:
    rows: defaultdict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    lengths: list[tuple[int, str]] = []
    between: Counter[tuple[str, str]] = Counter()
    sources = {
        path: path.read_text() for package in PACKAGES for path in sorted((root / package).rglob("*.py"))
    }
    modules = {_module(path.relative_to(root)) for path in sources}
    for path, source in sources.items():
        name, room = _module(path.relative_to(root)), _room(path.relative_to(root))
        tree = ast.parse(source)
        rows[room][0] += 1
        rows[room][1] += len(source.splitlines())
        lengths += _lengths(tree, name)
        for other in _imported(tree, modules):
            there = _room(
                Path(*other.split(".")) / "x"
                if (root / Path(*other.split("."))).is_dir()
                else Path(*other.split("."))
            )
            if there != room:
                between[room, there] += 1
                rows[room][2] += 1
    print(f"{'room':32} {'files':>5} {'lines':>6} {'imports from other rooms':>25}")
    for room, (files, lines, imports) in sorted(rows.items()):
        print(f"{room:32} {files:5} {lines:6} {imports:25}")
    files, lines, imports = (sum(column) for column in zip(*rows.values(), strict=True))
    print(f"{'all':32} {files:5} {lines:6} {imports:25}")
    longest = sorted(lengths, reverse=True)[:3]
    print(
        f"functions: {len(lengths)}, median {statistics.median(size for size, _ in lengths):g} lines, longest:"
    )
    print("\n".join(f"  {size:3} {name}" for size, name in longest))


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _room(path: Path) -> str:
    return "/".join(path.parts[:-1]) or str(path)


def _lengths(tree: ast.Module, module: str) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield (node.end_lineno or node.lineno) - node.lineno + 1, f"{module}.{node.name}"


def _imported(tree: ast.Module, modules: set[str]) -> Iterator[str]:
    """Each module of ours that an import statement names, once a statement."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from (whole & modules) or ({node.module} & modules)


def _print_survey() -> None:
    crossed = survey_modules()
    every = {name for name in sys.modules if name.partition(".")[0] in PACKAGES}
    print(f"one survey from POST to results runs code of {len(crossed)} modules ({len(every)} are loaded)")
    print("\n".join(f"  {name}" for name in sorted(crossed)))


def survey_modules() -> set[str]:
    """Run a map and a survey of a made-up room in this process; return the modules whose functions the survey called."""
    from fastapi.testclient import TestClient

    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"SPICD_DATA_DIR": folder, "SPICD_DEVICE": "cpu"}
        app_module = importlib.import_module("service.api.app")
        settings = importlib.import_module("service.settings").Settings()
        app = app_module.create_app(settings, queue=_NoQueue())
        crossed: set[str] = set()
        _watch(crossed)  # before the threads that answer requests begin
        with TestClient(app, base_url="http://localhost") as client:
            scan = _scan(client, _room_points(seed=0), "before.ply")
            _run(client.post("/maps", json={"id": "room", "scan_ids": [scan]}).json(), "map")
            scan = _scan(client, _room_points(seed=1), "after.ply")
            crossed.clear()
            try:
                answer = client.post("/maps/room/surveys", json={"scan_ids": [scan]}).json()
                _run(answer, "survey")
                tiles = client.get(f"/surveys/{answer['survey_id']}/tiles").json()
            finally:
                sys.setprofile(None)
            if not tiles["features"]:
                raise RuntimeError(f"the survey has no tiles: {json.dumps(tiles)[:300]}")
    return crossed


class _NoQueue:
    """Takes every job and runs none."""

    def submit(self, *_: Any) -> None: ...
    def dismiss(self, *_: Any) -> None: ...
    def ping(self) -> None: ...
    def holds(self, *_: Any) -> bool:
        return True


def _scan(client: Any, points: np.ndarray[Any, Any], name: str) -> str:
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "property float x\nproperty float y\nproperty float z\nend_header\n"
    body = header.encode() + points.astype("<f4").tobytes()
    sent = client.post(
        f"/scans?filename={name}", content=body, headers={"content-type": "application/octet-stream"}
    )
    return str(sent.json()["scan_id"])


def _run(accepted: dict[str, Any], kind: str) -> None:
    for step in importlib.import_module("service.catalog.steps").STEPS[kind]:
        module, function = step.function.rsplit(".", 1)
        getattr(importlib.import_module(module), function)(accepted["job_id"])


def _watch(crossed: set[str]) -> None:
    """Note the module of every Python function of ours that is called in this thread and in new ones."""
    import threading

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_name != "<module>":
            name = str(frame.f_globals.get("__name__", ""))
            if name.partition(".")[0] in PACKAGES:
                crossed.add(name)

    threading.setprofile(note)
    sys.setprofile(note)


def _room_points(*, seed: int) -> np.ndarray[Any, Any]:
    """(N, 3) metres: walls, floor and ceiling of a room 6 x 4.5 x 2.6 m with three boxes, one a corner cut off."""
    rng = np.random.default_rng(seed)

    def surface(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray[Any, Any]:
        size = np.sort(np.subtract(high, low))[1:]
        return rng.uniform(low, high, (int(900 * size.prod()), 3))

    def box(x: float, y: float, z: float, to: tuple[float, float, float]) -> list[np.ndarray[Any, Any]]:
        low, high = np.array([x, y, z]), np.array(to)
        faces = []
        for axis in range(3):
            for side in (low, high):
                a, b = low.copy(), high.copy()
                a[axis] = b[axis] = side[axis]
                faces.append(surface(tuple(a), tuple(b)))
        return faces

    parts = [
        *box(-3.0, -2.2, 0.0, (3.0, 2.3, 2.6)),
        *box(-2.9, 1.0, 0.0, (-1.6, 2.2, 1.1)),
        *box(1.0, -2.1, 0.0, (2.0, -1.5, 1.9)),
        *box(0.2, 0.4, 0.0, (0.9, 1.4, 0.7)),
    ]
    points = np.concatenate(parts)
    return points + rng.normal(scale=0.005, size=points.shape)


if __name__ == "__main__":
    main()
