"""Seconds to place one scan of a later visit in a map that is loaded already."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from worker.benchmarks.registration.scenario import DRIFT, WalkSettings, scene_of
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.scan_to_map import register
from worker.pipeline.settings import PipelineSettings
from worker.simulation.visits import drifted_within, stops, visit

REPEATS = 7  #: after one that warms up


def time_survey(
    reference: ReferenceMap, true_from_map: Matrix4, walk: WalkSettings, folder: Path
) -> dict[str, Any]:
    """Register a scan from the middle of a second visit, its prior drifted, over and over; JSON-ready.

    The map's surface and tree are made once, before the clock runs; reading the file is counted apart,
    voxels and normals of the scan are part of registering it.
    """
    scene, settings = scene_of(walk), PipelineSettings().registration
    poses = stops(scene, walk.scans, seed=walk.seed + 1)
    (seen,) = visit(
        scene,
        (poses[len(poses) // 2],),
        seed=walk.seed + 1,
        prior_error=DRIFT,
        drift=drifted_within,
        duration_s=walk.duration_s,
    )
    path = folder / "survey.pcd"
    write_pcd(path, seen.points)
    map_from_true = inverse(true_from_map)
    surface, start = reference.surface(), map_from_true @ seen.prior
    reading, registering, processor = [], [], []
    for _ in range(REPEATS + 1):
        begun, used = time.perf_counter(), time.process_time()
        scan = read_scan(path)
        read = time.perf_counter()
        found = register(prepare(scan, settings), surface, start=start, settings=settings)
        reading.append(read - begun)
        registering.append(time.perf_counter() - read)
        processor.append(time.process_time() - used)
    metres, radians = difference(map_from_true @ seen.world_from_sensor, found.found.target_from_source)
    return {
        "points": len(scan.points),
        "map_points": len(reference.points),
        "read_seconds": float(np.median(reading[1:])),
        "register_seconds": float(np.median(registering[1:])),
        "register_least": min(registering[1:]),
        "register_most": max(registering[1:]),
        "processor_seconds": float(np.median(processor[1:])),
        "centimetres": 100 * metres,
        "degrees": float(np.degrees(radians)),
    }
