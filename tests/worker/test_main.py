"""`python -m worker`: what it does before it works."""

from __future__ import annotations

import os

import pytest

from worker.__main__ import main


def test_what_a_worker_writes_is_its_owners_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPICD_REDIS_URL", raising=False)
    before = os.umask(0o022)
    try:
        assert main(["geometry"]) == 2  # there is no queue to work on
        assert os.umask(0o022) == 0o077
    finally:
        os.umask(before)
