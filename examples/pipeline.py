"""Use the pipeline as a library: build a map of one visit, compare the next visit with it, list what changed.

    python examples/pipeline.py monday.pcd tuesday.pcd tuesday-2.pcd

The first file (PLY, PCD, E57, LAS or LAZ) is the earlier visit, the others are the later one. Without files two visits to a
room are simulated, between which things come, go and move. `changes.ply` shows the result.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from worker.cloud.formats.pcd import write_pcd
from worker.detectors.card import MODEL_STORE
from worker.detectors.store import open_detector
from worker.pipeline import PipelineSettings, ScanFile, build_map, detect, locate_survey
from worker.pipeline.results.export import TileResult, tile_results, write_coloured_cloud
from worker.simulation.scenes import random_edits, random_room
from worker.simulation.visits import visit


def changed_tiles(before: list[ScanFile], after: list[ScanFile], cloud: Path) -> list[TileResult]:
    """Return the tiles that changed between two visits, and write the later one as a coloured cloud."""
    detector = open_detector(MODEL_STORE, "voxel-net/1")
    settings = PipelineSettings().for_model(detector.card.preprocessing)
    built = build_map(before, settings=settings)
    survey = locate_survey(after, built.reference, settings=settings, reference_seen=built.seen)
    changes = detect(survey.comparison, detector, placement=survey.placement)
    write_coloured_cloud(cloud, built.reference.points, survey.current.points, changes)
    return [tile for tile in tile_results(changes) if tile.state == "changed"]


def simulated_visits(folder: Path) -> list[ScanFile]:
    """Scan a room before and after three edits, one scan each."""
    room = random_room(5)
    edited, _ = random_edits(room, seed=1)
    files = []
    for number, scene in enumerate((room, edited)):
        scan = visit(scene, 1, seed=number)[0]
        file = ScanFile(name=f"visit-{number}.pcd", path=folder / f"visit-{number}.pcd", pose=scan.prior)
        write_pcd(file.path, scan.points)
        files.append(file)
    return files


def main(names: list[str]) -> None:
    """Compare the named files, or two simulated visits."""
    with tempfile.TemporaryDirectory() as folder:
        files = [ScanFile(name=name, path=Path(name)) for name in names] or simulated_visits(Path(folder))
        for tile in changed_tiles(files[:1], files[1:], Path("changes.ply")):
            print(f"{tile.tile_id} from {tile.lower} to {tile.upper} m: {tile.score:.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
