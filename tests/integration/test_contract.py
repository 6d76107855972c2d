"""A short version of `make schemathesis`: what an API answers is what its document says, for sound and spoiled requests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.breaking.contract import PHASES, check, serving
from tests.support.tools import needs_tools


@needs_tools
@pytest.mark.timeout(240)
def test_schemathesis_finds_no_failure(tmp_path: Path) -> None:
    words = ("--max-time", "90", "--max-examples", "5", "--seed", "1", "--phases", ",".join(PHASES))
    with serving(tmp_path) as contract:
        done = check(contract, tmp_path, *words)
    assert done.returncode == 0, done.stdout + done.stderr
