"""New versions of a map: further scans, or a survey that is the new state of things."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.rooms import Room
from tests.support.walks import MANY, QUICK, registered, written
from worker.cloud.poses import difference
from worker.cloud.seen import Seen
from worker.cloud.tiling import TileGrid
from worker.cloud.types import Floats, Points
from worker.pipeline.flow import BuiltMap, NoScanAccepted, build_map
from worker.pipeline.map_update import KeptMap, extend_map, renew_map, without
from worker.pipeline.mapping.fusion import fuse, reference_map
from worker.pipeline.registration.results import RegisteredScan, ScanFile, ScanResult, read_registered
from worker.pipeline.settings import PipelineSettings
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

SETTINGS = PipelineSettings(registration=QUICK.model_copy(update={"search_resolutions": ()}))


@pytest.fixture
def whole(room: Room, tmp_path: Path) -> ScanFile:
    """A scan of the whole room with its true pose."""
    scan = room.before[1]
    return written(tmp_path / "whole.pcd", scan, pose=scan.world_from_sensor, thinned=1)


def test_a_map_that_is_extended_holds_both_and_its_tiles_keep_their_ids(
    room: Room, whole: ScanFile, tmp_path: Path
) -> None:
    """The map knows the room's east; a scan of the whole room adds the west, where the indices fall below zero."""
    scan = room.before[0]
    east = written(tmp_path / "east.pcd", scan, between=(2.0, np.inf), pose=scan.world_from_sensor, thinned=1)
    built = build_map([east], settings=SETTINGS, processes=1)
    stages: list[str] = []
    grown = extend_map(
        _kept(built, [east]), [whole], settings=SETTINGS, progress=lambda stage, share: stages.append(stage)
    )
    assert [outcome.name for outcome in grown.outcomes] == ["whole.pcd"]
    found = registered(grown.outcomes[0])
    assert difference(found.map_from_scan, room.before[1].world_from_sensor)[0] < 0.015
    before, after = built.tiles, grown.tiles
    assert after.grid.origin.tolist() == before.grid.origin.tolist()
    assert after.grid.size.tolist() == before.grid.size.tolist()
    assert after.grid.lowest[0] < 0
    assert after.indices[:, 0].min() < 0
    assert {tuple(index) for index in before.indices} < {tuple(index) for index in after.indices}
    assert np.array_equal(grown.seen.points, grown.reference.points)
    assert grown.seen.hits.sum() > built.seen.hits.sum()
    assert [len(version.seen.sights or ()) for version in (built, grown)] == [1, 2]
    assert built.reference.points[:, 0].min() > 1.8
    assert grown.reference.points[:, 0].min() < 0.2
    assert grown.report is not None
    assert (grown.report.scans, grown.report.accepted, grown.report.reference) == (1, 1, None)
    assert list(dict.fromkeys(stages)) == ["registering", "fusing", "tiling"]
    for lower, points in zip(after.grid.lower(after.indices), after.points, strict=True):
        assert np.all((points >= lower - 1e-6) & (points < lower + after.grid.size))


def test_a_map_is_not_extended_by_scans_of_another_place(whole: ScanFile, tmp_path: Path) -> None:
    built = build_map([whole], settings=SETTINGS, processes=1)
    foreign = written(tmp_path / "foreign.pcd", visit(random_room(11), 1, seed=5)[0])
    with pytest.raises(NoScanAccepted, match=r"foreign\.pcd: ") as error:
        extend_map(_kept(built, [whole]), [foreign], settings=SETTINGS)
    assert len(error.value.outcomes) == 1


def _kept(built: BuiltMap, files: Sequence[ScanFile]) -> KeptMap:
    def loader(file: ScanFile, outcome: ScanResult) -> Callable[[], RegisteredScan]:
        return lambda: read_registered(file, registered(outcome), max_points=MANY)

    scans = [loader(*each) for each in zip(files, built.outcomes, strict=True)]
    return KeptMap(reference=built.reference, scans=scans, seen=built.seen)


def _scan_of(*parts: Floats | Points) -> RegisteredScan:
    return RegisteredScan(
        name="scan",
        points=np.concatenate(parts).astype(np.float32),
        colors=None,
        map_from_scan=np.eye(4),
        sensor_origin=None,
    )


def test_a_renewed_map_has_the_surveys_points_where_they_replace_and_both_elsewhere() -> None:
    """Two tiles side by side; older points lie in the lower half of each, the survey's in the upper one."""
    lower, upper = np.array([0.2, 0.2, 0.05]), np.array([0.2, 0.2, 0.55])
    size = np.array([1.1, 1.1, 0.4])
    rng = np.random.default_rng(0)

    def part(tile: int, corner: Floats) -> Floats:
        return corner + (1.5 * tile, 0, 0) + rng.uniform(0, 1, (3000, 3)) * size

    older, seen = (_scan_of(*(part(tile, corner) for tile in (0, 1))) for corner in (lower, upper))
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(2, 1, 1))
    reference = reference_map(fuse([older], voxel_size=0.05), grid=grid, settings=SETTINGS.registration)
    base = KeptMap(reference=reference, scans=[lambda: older], seen=Seen.of([older], voxel_size=0.05))
    stages: list[str] = []
    renewed = renew_map(
        base,
        [lambda: seen],
        replaced=np.array([[1, 0, 0]], np.int32),
        settings=SETTINGS,
        progress=lambda stage, share: stages.append(stage),
    )
    assert renewed.tiles.indices.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert renewed.tiles.grid.origin.tolist() == [0, 0, 0]
    both, replaced = renewed.tiles.points
    assert both[:, 2].min() < 0.1
    assert both[:, 2].max() > 0.9
    assert replaced[:, 2].min() > 0.5
    assert len(both) == pytest.approx(2 * len(replaced), rel=0.05)
    assert renewed.outcomes == ()
    assert list(dict.fromkeys(stages)) == ["fusing", "tiling"]
    assert older.points[:, 2].max() < 0.5  # what is kept of the older version stays as it was


def test_a_scan_loses_the_points_of_the_tiles_that_are_replaced_with_their_colours() -> None:
    points = np.array([[0.5, 0.5, 0.5], [2.0, 0.5, 0.5], [-0.5, 0.5, 0.5]], np.float32)
    colors = np.array([[1, 1, 1], [2, 2, 2], [3, 3, 3]], np.uint8)
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(3, 1, 1), lowest=(-1, 0, 0))
    scan = replace(_scan_of(points), colors=colors)
    left = without(scan, grid, np.array([[1, 0, 0], [-1, 0, 0]], np.int32))
    assert left.points.tolist() == points[:1].tolist()
    assert left.colors is not None
    assert left.colors.tolist() == [[1, 1, 1]]
    assert len(without(scan, grid, np.empty((0, 3), np.int32)).points) == 3


def _across(x: float) -> Points:
    """A wall of 2 x 2 m across the x axis, a point every 2 cm."""
    y, z = np.meshgrid(np.arange(-0.99, 1, 0.02), np.arange(-0.99, 1, 0.02))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()]).astype(np.float32)


def _standing(points: Points) -> RegisteredScan:
    return replace(_scan_of(points), sensor_origin=np.zeros(3))


def test_where_a_survey_replaces_a_map_its_older_scans_no_longer_count_as_having_looked() -> None:
    """A wall at x = 5 m was seen through the place of a second one, which the survey found at 2 m."""
    older, newer = _standing(_across(5.0) * np.array([1, 3, 1], np.float32)), _standing(_across(2.0))
    grid = TileGrid(origin=np.array([1.5, -0.5, -0.5]), size=np.ones(3), shape=(4, 1, 1))
    reference = reference_map(fuse([older], voxel_size=0.05), grid=grid, settings=SETTINGS.registration)
    base = KeptMap(reference=reference, scans=[lambda: older], seen=Seen.of([older], voxel_size=0.05))
    there = np.array([[2.0, 0.0, 0.0], [5.0, 2.5, 0.5]], np.float32)
    assert base.seen.verdicts(there).surely.tolist() == [1, 0]
    settings = SETTINGS.with_values(tiling=SETTINGS.tiling.with_values(min_points=1))
    renewed = renew_map(base, [lambda: newer], replaced=np.array([[0, 0, 0]], np.int32), settings=settings)
    verdicts = renewed.seen.verdicts(there)
    assert verdicts.through.tolist() == [0, 0]  # the older scan saw through it, but no longer says so
    assert verdicts.confirmed.tolist() == [1, 1]  # by the survey; beside the tile the older scan still counts
    assert np.array_equal(renewed.seen.points, renewed.reference.points)
