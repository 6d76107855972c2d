"""A survey without a service: files in, files and one JSON document out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from service.object_features import ring_of, sighting_feature
from service.tile_features import footprint, geojson_collection, local_footprint, tile_feature
from worker.cli.scan_results import placement_document, verdict
from worker.detectors.detector import Detector
from worker.pipeline import (
    BuiltMap,
    LocatedSurvey,
    PipelineSettings,
    build_map,
    detect,
    locate_survey,
)
from worker.pipeline.registration.results import ScanResult, files_of
from worker.pipeline.results.changes import ChangeSet
from worker.pipeline.results.export import tile_results, write_coloured_cloud
from worker.pipeline.results.picture import draw_picture
from worker.pipeline.results.sheet import LeftOut
from worker.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True, slots=True)
class TwoVisits:
    """Two visits, and what is different."""

    built: BuiltMap
    located: LocatedSurvey
    changes: ChangeSet


def compare(
    references: Sequence[Path],
    currents: Sequence[Path],
    detector: Detector,
    *,
    threshold: float | None = None,
    progress: Progress = no_progress,
) -> TwoVisits:
    """Return the whole method on files. Raises PipelineError, and OSError for a file that is not there."""
    settings = PipelineSettings.model_validate({}).for_model(detector.card.preprocessing)
    earlier, later = ([file for path in paths for file in files_of(path)] for paths in (references, currents))
    on_map, on_survey = _titled("map", progress), _titled("survey", progress)
    built = build_map(earlier, settings=settings, progress=on_map)
    located = locate_survey(
        later, built.reference, settings=settings, reference_seen=built.seen, progress=on_survey
    )
    changes = detect(
        located.comparison,
        detector,
        threshold=threshold,
        settings=settings,
        placement=located.placement,
        progress=on_survey,
    )
    return TwoVisits(built=built, located=located, changes=changes)


def write_results(
    visits: TwoVisits, out: Path, *, map_id: str, survey_id: str, model: str
) -> dict[str, Path]:
    """Write `tiles.geojson`, `cloud.ply` and `picture.png` to the folder `out`, by what they are. Raises OSError.

    A detector of voxels finds objects as well, which come as `objects.geojson`. The features are plain GeoJSON in the
    frame of the first reference, metres, and say so.
    """
    out.mkdir(parents=True, exist_ok=True)
    survey = {"map_id": map_id, "survey_id": survey_id, "model": model, "captured_at": None}
    threshold = {"threshold": visits.changes.threshold}
    tiles = [
        tile_feature(
            **asdict(tile),
            survey={**survey, **threshold},
            geometry=local_footprint(footprint(tile.lower, tile.upper), tile.lower[2]),
        )
        for tile in tile_results(visits.changes)
    ]
    files = {"tiles": _written(out / "tiles.geojson", geojson_collection(tiles, in_map_frame=True))}
    if visits.changes.objects is not None:
        found = [asdict(thing) for thing in visits.changes.objects.objects]
        things = [
            sighting_feature(thing, survey=survey, geometry=local_footprint(*ring_of(thing)))
            for thing in found
        ]
        files["objects"] = _written(out / "objects.geojson", geojson_collection(things, in_map_frame=True))
    files |= {"cloud": out / "cloud.ply", "picture": out / "picture.png"}
    clouds = visits.built.reference.points, visits.located.current.points
    write_coloured_cloud(files["cloud"], *clouds, visits.changes)
    title = f"{survey_id} compared with {map_id}"
    left_out = [
        LeftOut(name=Path(one.name).name, reason=one.diagnosis.reason, detail=one.diagnosis.detail)
        for one in visits.located.outcomes
        if one.diagnosis is not None
    ]
    draw_picture(files["picture"], *clouds, visits.changes, title=title, left_out=left_out)
    return files


def _written(path: Path, collection: dict[str, Any]) -> Path:
    path.write_text(json.dumps(collection, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path


def document(visits: TwoVisits, files: dict[str, Path], *, model: str) -> dict[str, Any]:
    """Return the comparison, JSON-ready; changed tiles most certain first, metres, frame of the first reference.

    `objects` is null where the detector scores tiles alone, and where the placement of the later visit is in doubt.
    """
    changed = [tile for tile in tile_results(visits.changes) if tile.state == "changed"]
    found = visits.changes.objects
    return {
        "model": model,
        "threshold": visits.changes.threshold,
        "placement": placement_document(visits.located.placement),
        "counts": {"tiles": len(visits.changes.states), **visits.changes.counts()},
        "objects": None if found is None else [asdict(thing) for thing in found.objects],
        "moving": None if found is None else found.moving,
        "reference": [_registration(outcome) for outcome in visits.built.outcomes],
        "current": [_registration(outcome) for outcome in visits.located.outcomes],
        "changed": [asdict(tile) for tile in sorted(changed, key=lambda tile: -(tile.score or 0.0))],
        "files": {what: str(path) for what, path in files.items()},
    }


def _titled(phase: str, progress: Progress) -> Progress:
    return lambda stage, share: progress(f"{phase}: {stage}", share)


def _registration(outcome: ScanResult) -> dict[str, Any]:
    registration = outcome.registration
    sigma = None if registration is None else registration.uncertainty
    return {
        "name": outcome.name,
        **verdict(outcome),
        "fitness": outcome.fitness,
        "rmse": outcome.inlier_rmse,
        "map_from_scan": None if registration is None else registration.map_from_scan.tolist(),
        "translation_sigma": None if sigma is None else sigma.translation,
        "rotation_sigma": None if sigma is None else sigma.rotation,
    }
