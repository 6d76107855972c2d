"""Tiles as features: OGC Features and Geometries JSON 1.0 (JSON-FG, OGC 21-045r1), and plain GeoJSON made of it.

A tile is a Prism in the map's own frame: metres, z up. GeoJSON's `geometry` admits WGS 84 alone (RFC 7946, Section 4),
so it is null where nobody said where the map lies. `geojson_collection` is the profile "rfc7946" of JSON-FG, which
other programs read; there a footprint may be in the map's frame where somebody asked for that. Plain JSON values: the
API checks and answers with them (`service.api.gis.features`), `spicd-worker detect` writes them to a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Corner = tuple[float, float, float]  #: metres, map frame
Ring = tuple[tuple[float, float], ...]

CONFORMS_TO = (
    "http://www.opengis.net/spec/json-fg-1/1.0/conf/core",
    "http://www.opengis.net/spec/json-fg-1/1.0/conf/prisms",
)
FEATURE_TYPE = "spicd-tile"
#: OGC's name for a local Cartesian frame of three axes in metres, z up (JSON-FG repository, core/crs).
MAP_FRAME = "http://www.opengis.net/def/crs/OGC/0/Engineering3D"
#: The same as GDAL reads it, and so GeoPandas and QGIS (WKT 2, ISO 19162): no place on the Earth. PROJ has no entry of
#: OGC's name, and what it does not know GDAL takes for WGS 84.
MAP_FRAME_WKT = (
    'ENGCRS["SPICD map frame",EDATUM["SPICD map"],CS[Cartesian,3],AXIS["x",unspecified],AXIS["y",unspecified],'
    'AXIS["z",up],LENGTHUNIT["metre",1]]'
)


def tile_collection(features: Iterable[dict[str, Any]], *, matched: int | None = None) -> dict[str, Any]:
    """Return a FeatureCollection of tiles without links; `matched` counts those of every page, left out: these."""
    return feature_collection(features, FEATURE_TYPE, matched=matched)


def feature_collection(
    features: Iterable[dict[str, Any]], feature_type: str, *, matched: int | None = None
) -> dict[str, Any]:
    """Return a FeatureCollection of one type in the map's frame, without links."""
    features = list(features)
    return {
        "type": "FeatureCollection",
        "conformsTo": list(CONFORMS_TO),
        "featureType": feature_type,
        "coordRefSys": MAP_FRAME,
        "numberMatched": len(features) if matched is None else matched,
        "numberReturned": len(features),
        "links": [],
        "features": features,
    }


def geojson_collection(
    features: Iterable[Mapping[str, Any]], *, matched: int | None = None, in_map_frame: bool = False
) -> dict[str, Any]:
    """Return the same features as plain GeoJSON (JSON-FG, "GeoJSON Profiles"), without links.

    `in_map_frame`: their `geometry` is in the map's frame. The member `crs` says so, as GeoJSON had it before RFC 7946,
    and as the profile permits where the frame was asked for.
    """
    shown = [geojson_feature(feature) for feature in features]
    return {
        "type": "FeatureCollection",
        **(map_frame_member() if in_map_frame else {}),
        "numberMatched": len(shown) if matched is None else matched,
        "numberReturned": len(shown),
        "links": [],
        "features": shown,
    }


def geojson_feature(feature: Mapping[str, Any]) -> dict[str, Any]:
    """Return a feature with the members of GeoJSON alone; GDAL takes `place` and `time` for signs of JSON-FG."""
    return {name: feature[name] for name in ("type", "id", "geometry", "properties")}


def map_frame_member() -> dict[str, Any]:
    """Return the member that tells a reader of GeoJSON that coordinates are in the map's frame."""
    return {"crs": {"type": "name", "properties": {"name": MAP_FRAME_WKT}}}


def local_footprint(ring: Ring, lower: float) -> dict[str, Any]:
    """Return a closed footprint at the height `lower` as a GeoJSON polygon in the map's frame, metres."""
    return {"type": "Polygon", "coordinates": [[[x, y, lower] for x, y in ring]]}


def tile_feature(
    *,
    tile_id: str,
    tile_index: Sequence[int],
    lower: Corner,
    upper: Corner,
    state: str,
    score: float | None,
    probabilities: Sequence[float] | None,
    n_reference: int,
    n_current: int,
    observed_share: float | None = None,
    appeared: int | None = None,
    disappeared: int | None = None,
    survey: Mapping[str, Any],
    geometry: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return one tile of a survey.

    `survey` holds the properties that all its tiles share, `survey_id` and `captured_at` (RFC 3339) among them; where
    the latter is None, `time` is null. `geometry` is the footprint in WGS 84. What a detector of voxels alone says is
    None for others. What is a list is there in flat numbers as well, of which table programs make columns.
    """
    captured_at = survey["captured_at"]
    center = [round((low + high) / 2, 6) for low, high in zip(lower, upper, strict=True)]
    p_unchanged, p_changed, p_different = probabilities or (None, None, None)
    return {
        "type": "Feature",
        "id": f"{survey['survey_id']}.{tile_id}",
        "geometry": geometry,
        "place": prism(footprint(lower, upper), lower[2], upper[2]),
        "time": None if captured_at is None else {"timestamp": captured_at},
        "properties": {
            "tile_id": tile_id,
            "tile_index": list(tile_index),
            "center": center,
            "center_x": center[0],
            "center_y": center[1],
            "z_min": lower[2],
            "z_max": upper[2],
            "state": state,
            "score": score,
            "probabilities": None if probabilities is None else list(probabilities),
            "p_unchanged": p_unchanged,
            "p_changed": p_changed,
            "p_different": p_different,
            "n_reference": n_reference,
            "n_current": n_current,
            "observed_share": observed_share,
            "appeared": appeared,
            "disappeared": disappeared,
            **survey,
        },
    }


def prism(ring: Ring, lower: float, upper: float) -> dict[str, Any]:
    """Return an upright solid over its closed footprint (JSON-FG, Prism)."""
    base = {"type": "Polygon", "coordinates": [[list(corner) for corner in ring]]}
    return {"type": "Prism", "base": base, "lower": lower, "upper": upper}


def footprint(lower: Corner, upper: Corner) -> Ring:
    """Return the outline of a box seen from above, counter-clockwise and closed."""
    (x0, y0, _), (x1, y1, _) = lower, upper
    return (x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)
