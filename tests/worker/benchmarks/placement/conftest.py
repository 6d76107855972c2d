"""One small room, mapped once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.placement import ROOM, SETTINGS
from worker.benchmarks.placement.sites import PlacementSite, load_site


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the map is kept."""
    return tmp_path_factory.mktemp("placement")


@pytest.fixture(scope="session")
def site(folder: Path) -> PlacementSite:
    """A room that no part of the benchmark has, in a map of three short scans."""
    return load_site(ROOM, SETTINGS, folder)
