"""Tiles as features, for answers that no service gives: the shape of the service's own (JSON-FG 1.0, OGC 21-045r1).

A tile is a Prism in the map's frame, metres, z up; GeoJSON's `geometry` admits WGS 84 alone and so is null.
"""

from __future__ import annotations

from typing import Any

from worker.pipeline.changes import ChangeSet
from worker.pipeline.export import TileResult, tile_results

CONFORMS_TO = (
    "http://www.opengis.net/spec/json-fg-1/1.0/conf/core",
    "http://www.opengis.net/spec/json-fg-1/1.0/conf/prisms",
)
MAP_FRAME = "http://www.opengis.net/def/crs/OGC/0/Engineering3D"


def feature_collection(
    changes: ChangeSet, *, map_id: str, survey_id: str, model: str, captured_at: str | None = None
) -> dict[str, Any]:
    """Every tile of the map, JSON-ready. `captured_at` is RFC 3339; where it is unknown, `time` is null."""
    properties = {
        "map_id": map_id,
        "survey_id": survey_id,
        "model": model,
        "captured_at": captured_at,
        "threshold": changes.threshold,
    }
    features = [_feature(tile, properties) for tile in tile_results(changes)]
    return {
        "type": "FeatureCollection",
        "conformsTo": list(CONFORMS_TO),
        "featureType": "spicd-tile",
        "coordRefSys": MAP_FRAME,
        "numberMatched": len(features),
        "numberReturned": len(features),
        "links": [],
        "features": features,
    }


def _feature(tile: TileResult, shared: dict[str, Any]) -> dict[str, Any]:
    (x0, y0, z0), (x1, y1, z1) = tile.lower, tile.upper
    footprint = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]  # counter-clockwise, closed
    captured_at = shared["captured_at"]
    return {
        "type": "Feature",
        "id": f"{shared['survey_id']}.{tile.tile_id}",
        "geometry": None,
        "place": {
            "type": "Prism",
            "base": {"type": "Polygon", "coordinates": [footprint]},
            "lower": z0,
            "upper": z1,
        },
        "time": None if captured_at is None else {"timestamp": captured_at},
        "properties": {
            "tile_id": tile.tile_id,
            "tile_index": list(tile.tile_index),
            "center": [round((x0 + x1) / 2, 6), round((y0 + y1) / 2, 6), round((z0 + z1) / 2, 6)],
            "state": tile.state,
            "score": tile.score,
            "probabilities": None if tile.probabilities is None else list(tile.probabilities),
            "n_reference": tile.n_reference,
            "n_current": tile.n_current,
            **shared,
        },
    }
