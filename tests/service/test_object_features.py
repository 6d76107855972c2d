"""Objects as features, of plain values."""

from __future__ import annotations

import math
from typing import Any

import pytest

from service.object_features import object_collection, object_feature, ring_of, sighting_feature
from tests.support.samples import place, thing

SURVEY: dict[str, Any] = {"survey_id": "later.ply", "map_id": "earlier.ply", "captured_at": None}


def test_what_disappeared_lies_where_it_was() -> None:
    gone = thing(3, before=place(4, 1)).model_dump()
    made = sighting_feature(gone, survey=SURVEY)
    assert made["id"] == "later.ply.object_3"
    assert made["time"] is None
    assert made["properties"]["now"] is None
    assert made["place"]["base"]["coordinates"][0] == made["properties"]["before"]["footprint"]
    assert ring_of(gone) == (tuple(map(tuple, made["properties"]["before"]["footprint"])), 0.0)


def test_what_moved_lies_where_it_is_now() -> None:
    moved = thing(1, now=place(7, 1), before=place(4, 1)).model_dump()
    made = sighting_feature(moved, survey={**SURVEY, "captured_at": "2026-03-01T12:00:00Z"})
    assert made["place"]["base"]["coordinates"][0] == made["properties"]["now"]["footprint"]
    assert made["time"] == {"timestamp": "2026-03-01T12:00:00Z"}
    assert made["properties"]["motion"] == {"translation": [3.0, 0.0, 0.0], "yaw_degrees": 0.0}


def test_people_read_degrees_and_a_closed_outline() -> None:
    box = sighting_feature(thing(1, now=place(1, 1, yaw=math.pi / 6)).model_dump(), survey=SURVEY)
    now = box["properties"]["now"]
    assert now["yaw_degrees"] == pytest.approx(30)
    assert now["footprint"][0] == now["footprint"][-1]
    assert len(now["footprint"]) == 5


def test_an_object_over_time_has_the_id_and_the_interval_of_its_history() -> None:
    history = {
        "object_id": "object-1",
        "first_seen": "2026-03-01T12:00:00Z",
        "last_seen": "2026-03-02T12:00:00Z",
    }
    made = object_feature(thing(1, now=place(1, 1)).model_dump(), history=history)
    assert made["id"] == "object-1"
    assert made["time"] == {"interval": ["2026-03-01T12:00:00Z", "2026-03-02T12:00:00Z"]}
    assert object_collection([made], matched=9)["numberMatched"] == 9
    assert object_collection([made])["featureType"] == "spicd-object"
