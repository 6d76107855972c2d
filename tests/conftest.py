"""Fixtures for every test."""

from __future__ import annotations

from pathlib import Path

import pytest

from worker.threads import wait_passively

wait_passively()  # before any test imports torch


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scans beside the project; tests that need it are skipped where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real scans at {folder}")
    return folder
