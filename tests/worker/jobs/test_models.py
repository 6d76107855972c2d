"""What a step takes of the service's settings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from service.settings import Settings
from tests.support.running_service import ROOT
from worker.detectors.store import open_card
from worker.jobs.models import pipeline_settings


def test_memory_and_points_are_bounded_by_the_service_whatever_a_map_asked_for() -> None:
    context: Any = SimpleNamespace(settings=Settings(map_memory_bytes=20 << 20, max_scan_points=1000))
    version: Any = SimpleNamespace(settings={"memory_bytes": 1 << 40, "max_scan_points": 1 << 40})
    card = open_card(ROOT / "model_store", "voxel-net/1")
    settings = pipeline_settings(context, version, card)
    assert (settings.memory_bytes, settings.max_scan_points) == (20 << 20, 1000)
