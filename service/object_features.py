"""Objects as features: OGC Features and Geometries JSON 1.0 (JSON-FG), like tiles in `service.tile_features`.

An object is a Prism over its footprint, where it is now, and where it was if it is there no more. Plain JSON values:
`thing` has the members of `service.catalog.records.ObjectRecord`, angles in radians, outlines open.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from service.tile_features import Ring, feature_collection, prism

FEATURE_TYPE = "spicd-object"

Thing = Mapping[str, Any]


def object_collection(features: Iterable[dict[str, Any]], *, matched: int | None = None) -> dict[str, Any]:
    """Return a FeatureCollection of objects without links; `matched` counts those of every page, left out: these."""
    return feature_collection(features, FEATURE_TYPE, matched=matched)


def sighting_feature(
    thing: Thing, *, survey: Mapping[str, Any], geometry: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return an object as one survey saw it.

    `survey` holds the properties that all its objects share, `survey_id` and `captured_at` (RFC 3339 or None) among
    them. `geometry` is the footprint in WGS 84.
    """
    captured_at = survey["captured_at"]
    time = None if captured_at is None else {"timestamp": captured_at}
    feature_id = f"{survey['survey_id']}.object_{thing['number']}"
    return _feature(feature_id, thing, time, geometry, survey)


def object_feature(
    thing: Thing, *, history: Mapping[str, Any], geometry: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return an object over all surveys; `thing` is what stands of it.

    `history` holds its other properties: `object_id`, `first_seen` and `last_seen` (RFC 3339) among them.
    """
    time = {"interval": [history["first_seen"], history["last_seen"]]}
    return _feature(history["object_id"], thing, time, geometry, history)


def ring_of(thing: Thing) -> tuple[Ring, float]:
    """Return the closed outline of an object, counter-clockwise, and its lower height (metres, map frame)."""
    place = _shown(thing)
    return _closed(place), _heights(place)[0]


def _feature(
    feature_id: str,
    thing: Thing,
    time: dict[str, Any] | None,
    geometry: dict[str, Any] | None,
    more: Mapping[str, Any],
) -> dict[str, Any]:
    place = _shown(thing)
    return {
        "type": "Feature",
        "id": feature_id,
        "geometry": geometry,
        "place": prism(_closed(place), *_heights(place)),
        "time": time,
        "properties": {
            "number": thing["number"],
            "kind": thing["kind"],
            "now": _box(thing["now"]),
            "before": _box(thing["before"]),
            "motion": _motion(thing["motion"]),
            **_flat(place, thing["motion"]),
            "probability": thing["probability"],
            "observed_share": thing["observed_share"],
            "scans_seen_through": thing["scans_seen_through"],
            **more,
        },
    }


def _shown(thing: Thing) -> Mapping[str, Any]:
    place: Mapping[str, Any] = thing["now"] or thing["before"]
    return place


def _heights(place: Mapping[str, Any]) -> tuple[float, float]:
    middle, half = place["center"][2], place["size"][2] / 2
    return round(middle - half, 6), round(middle + half, 6)


def _closed(place: Mapping[str, Any]) -> Ring:
    corners = tuple((x, y) for x, y in place["footprint"])
    return (*corners, corners[0])


def _box(place: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return a place as clients see it: degrees, and a closed outline as in GeoJSON."""
    if place is None:
        return None
    return {
        "center": list(place["center"]),
        "size": list(place["size"]),
        "yaw_degrees": _degrees(place["yaw"]),
        "footprint": [list(corner) for corner in _closed(place)],
        **{name: place[name] for name in ("height_over_floor", "volume", "voxels", "points")},
        "tiles": list(place["tiles"]),
    }


def _flat(place: Mapping[str, Any], motion: Mapping[str, Any] | None) -> dict[str, float | None]:
    """Return where a thing is shown and how it was moved in flat numbers, of which table programs make columns."""
    z_min, z_max = _heights(place)
    size, translation = place["size"], (None, None, None) if motion is None else motion["translation"]
    return {
        "center_x": place["center"][0],
        "center_y": place["center"][1],
        "z_min": z_min,
        "z_max": z_max,
        **dict(zip(("size_x", "size_y", "size_z"), size, strict=True)),
        "yaw_degrees": _degrees(place["yaw"]),
        "height_over_floor": place["height_over_floor"],
        "volume": place["volume"],
        **dict(zip(("moved_x", "moved_y", "moved_z"), translation, strict=True)),
        "moved_yaw_degrees": None if motion is None or motion["yaw"] is None else _degrees(motion["yaw"]),
    }


def _motion(motion: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if motion is None:
        return None
    yaw = None if motion["yaw"] is None else _degrees(motion["yaw"])
    return {"translation": list(motion["translation"]), "yaw_degrees": yaw}


def _degrees(angle: float) -> float:
    return round(math.degrees(angle), 3)
