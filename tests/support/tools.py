"""Programs of other people that tests drive the service with, as `make tools` installs them under build/tools."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOOLS = ROOT / "build" / "tools"
TESTS = ROOT / "tests" / "tools"  #: scripts that run in that environment, and what it is made of
MISSING = "no tools of other people on this machine: `make tools` installs them"

needs_tools = pytest.mark.skipif(not (TOOLS / ".installed").exists(), reason=MISSING)


def run(program: str, *words: str | Path, cwd: Path | None = None, timeout_s: float = 120) -> str:
    """Run a program of build/tools (`python`, `node`, `schemathesis` ...); return what it printed.

    Raises AssertionError with all that it printed where it ends with another status than 0.
    """
    environment = {**os.environ, "PATH": f"{TOOLS / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    environment |= {"NODE_PATH": str(TOOLS / "node_modules"), "PYTHONPATH": ""}
    node = TOOLS / "node_modules" / ".bin" / program
    path = node if node.exists() else TOOLS / "bin" / program
    ended = subprocess.run(
        [str(path), *map(str, words)],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert ended.returncode == 0, (
        f"{program} {words} ended with {ended.returncode}:\n{ended.stdout}\n{ended.stderr}"
    )
    return ended.stdout
