"""A small room to map, and how its surveys are made, for tests of the placement benchmark."""

from __future__ import annotations

from worker.benchmarks.placement.plan import PlacementSettings, SitePlan

SETTINGS = PlacementSettings(sites=1, stops={"room": 3, "corridor": 4, "hotel-room": 3}, standing_s=1.0)
#: A room that no part of the benchmark has.
ROOM = SitePlan(kind="room", seed=2_700_000)
