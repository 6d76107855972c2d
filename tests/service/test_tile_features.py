"""Tiles as features: one shape for the API and for `spicd-worker detect`."""

from __future__ import annotations

from typing import Any

from service.api.gis.features import JSON_FG, MEDIA_TYPE, Form
from service.api.tiles import FgTileCollection, TileCollection, feature
from service.catalog.records import ChangeRecord
from service.tile_features import CONFORMS_TO, MAP_FRAME, geojson_collection, tile_collection, tile_feature
from tests.support.samples import NOON, tile

SURVEY: dict[str, Any] = {
    "map_id": "earlier.ply",
    "survey_id": "later.ply",
    "model": "spicd-net/1",
    "captured_at": None,
    "threshold": 0.5,
}
TILE: dict[str, Any] = {
    "tile_id": "tile_004_002_000",
    "tile_index": (4, 2, 0),
    "lower": (6.0, 3.0, 0.0),
    "upper": (7.5, 4.5, 1.0),
    "state": "changed",
    "score": 0.93,
    "probabilities": (0.05, 0.93, 0.02),
    "n_reference": 1904,
    "n_current": 2210,
}


def test_a_tile_is_a_prism_over_its_footprint_in_the_map_frame() -> None:
    made = tile_feature(**TILE, survey=SURVEY)
    assert made["id"] == "later.ply.tile_004_002_000"
    assert made["geometry"] is None
    ring = [[6.0, 3.0], [7.5, 3.0], [7.5, 4.5], [6.0, 4.5], [6.0, 3.0]]  # counter-clockwise, closed
    base = {"type": "Polygon", "coordinates": [ring]}
    assert made["place"] == {"type": "Prism", "base": base, "lower": 0.0, "upper": 1.0}
    assert made["properties"]["center"] == [6.75, 3.75, 0.5]


def test_what_is_shared_by_all_tiles_of_a_survey_stands_in_each() -> None:
    properties = tile_feature(**TILE, survey=SURVEY)["properties"]
    own = {"tile_id", "tile_index", "center", "state", "score", "probabilities", "n_reference", "n_current"}
    own |= {"observed_share", "appeared", "disappeared"}
    own |= {"center_x", "center_y", "z_min", "z_max", "p_unchanged", "p_changed", "p_different"}
    assert set(properties) == own | set(SURVEY)


def test_time_is_null_where_nobody_said_when() -> None:
    assert tile_feature(**TILE, survey=SURVEY)["time"] is None
    known = tile_feature(**TILE, survey={**SURVEY, "captured_at": "2026-03-01T12:00:00Z"})
    assert known["time"] == {"timestamp": "2026-03-01T12:00:00Z"}


def test_a_tile_that_was_not_observed_has_no_score_and_no_probabilities() -> None:
    unobserved = {**TILE, "state": "unobserved", "score": None, "probabilities": None}
    properties = tile_feature(**unobserved, survey=SURVEY)["properties"]
    assert (properties["score"], properties["probabilities"]) == (None, None)


def test_a_collection_counts_its_features_or_those_of_every_page() -> None:
    features = [tile_feature(**TILE, survey=SURVEY)] * 2
    whole = tile_collection(features)
    assert (whole["numberMatched"], whole["numberReturned"]) == (2, 2)
    assert (whole["conformsTo"], whole["coordRefSys"]) == (list(CONFORMS_TO), MAP_FRAME)
    assert tile_collection(features, matched=7)["numberMatched"] == 7


def test_the_documented_shape_holds_all_that_is_written() -> None:
    change = ChangeRecord(
        tile=tile(1, 2),
        map_id="lobby",
        map_version=1,
        survey_id="survey-1",
        model="spicd-net/1",
        threshold=0.5,
        captured_at=NOON,
    )
    form = Form(media_type=JSON_FG, in_map_frame=False, convert=None)
    made = tile_collection([feature(change, form)]) | {"timeStamp": "2026-03-01T12:05:00Z"}
    assert FgTileCollection.model_validate(made).model_dump(mode="json", exclude_unset=True) == made
    for in_map_frame in (False, True):
        form = Form(media_type=MEDIA_TYPE, in_map_frame=in_map_frame, convert=None)
        plain = geojson_collection([feature(change, form)], in_map_frame=in_map_frame)
        plain |= {"timeStamp": "2026-03-01T12:05:00Z"}
        assert TileCollection.model_validate(plain).model_dump(mode="json", exclude_unset=True) == plain


def test_plain_geojson_has_no_sign_of_json_fg_but_the_same_numbers() -> None:
    made = tile_feature(**TILE, survey=SURVEY)
    (plain,) = geojson_collection([made])["features"]
    assert plain == {name: made[name] for name in ("type", "id", "geometry", "properties")}
    told = plain["properties"]
    assert (told["z_min"], told["z_max"], told["center_x"], told["center_y"]) == (0.0, 1.0, 6.75, 3.75)
    assert (told["p_unchanged"], told["p_changed"], told["p_different"]) == (0.05, 0.93, 0.02)
