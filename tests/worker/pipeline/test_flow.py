"""The whole method on a simulated room, with a detector that counts points in the place of the network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.support.rooms import Room
from tests.support.tilings import row_of
from tests.support.walks import registered
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.poses import difference, inverse, transformed
from worker.cloud.tiling import Tiles
from worker.cloud.types import Arrays, Floats
from worker.detectors.card import Card, Preprocessing
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.errors import Cancelled, ScanError
from worker.pipeline.flow import (
    BuiltMap,
    LocatedSurvey,
    NoScanAccepted,
    NothingToTile,
    build_map,
    compare,
    detect,
    locate_survey,
)
from worker.pipeline.registration.results import RegisteredScan, ScanFile, SurveyPlacement
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.results.changes import TileState
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

NEEDS = Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512)
SETTINGS = PipelineSettings(
    registration=RegistrationSettings(search_resolutions=(), max_iterations=10)
).for_model(NEEDS)
EDGE = 0.5  # metres of the box that is put into the room


class Counting:
    """A detector that calls a tile changed as much as it has gained points."""

    card = Card(
        name="counting",
        version="1",
        detector="counting",
        summary="for tests",
        threshold=0.2,
        preprocessing=NEEDS,
    )

    def __init__(self) -> None:
        self.embeddings: list[Arrays | None] = []

    def encode_reference(self, reference: Side, tiles: Tiles, *, progress: Progress = no_progress) -> Arrays:
        return {}

    def detect(
        self, comparison: Comparison, *, embedding: Arrays | None = None, progress: Progress = no_progress
    ) -> Detection:
        self.embeddings.append(embedding)
        progress("scoring", 1.0)
        pairs = comparison.tile_pairs
        before = np.array([len(points) for points in pairs.reference.points])
        now = np.array([len(points) for points in pairs.current])
        gain = np.clip((now - before) / before, 0, 1)
        return Detection.of_scores(np.where(pairs.observed, gain, np.nan))


@dataclass(frozen=True)
class Told:
    """What the two halves made, and what they said on the way."""

    built: BuiltMap
    survey: LocatedSurvey
    of_map: list[tuple[str, float]]
    of_survey: list[tuple[str, float]]


@pytest.fixture(scope="module")
def files(room: Room, tmp_path_factory: pytest.TempPathFactory) -> list[ScanFile]:
    """Two scans of the first visit with their true poses."""
    folder = tmp_path_factory.mktemp("scans")
    made = []
    for number, scan in enumerate(room.before[:2]):
        path = folder / f"scan-{number}.pcd"
        write_pcd(path, scan.points)
        made.append(ScanFile(name=path.name, path=path, pose=scan.world_from_sensor))
    return made


@pytest.fixture(scope="module")
def told(files: list[ScanFile]) -> Told:
    of_map: list[tuple[str, float]] = []
    of_survey: list[tuple[str, float]] = []
    built = build_map(files, settings=SETTINGS, processes=1, progress=lambda *at: of_map.append(at))
    survey = locate_survey(
        files, built.reference, settings=SETTINGS, progress=lambda *at: of_survey.append(at)
    )
    return Told(built=built, survey=survey, of_map=of_map, of_survey=of_survey)


@pytest.fixture(scope="module")
def boxed(
    room: Room, told: Told, files: list[ScanFile], tmp_path_factory: pytest.TempPathFactory
) -> tuple[LocatedSurvey, int]:
    """The same survey with a box in the air of one tile, seen by its second scan; and that tile's row."""
    row, center = _free_place(told)
    box = _box_surface() + center
    scan = room.before[1]
    path = tmp_path_factory.mktemp("boxed") / "boxed.pcd"
    seen = np.concatenate([scan.points, transformed(box, inverse(scan.world_from_sensor))])
    write_pcd(path, seen.astype(np.float32))
    survey = [files[0], ScanFile(name=path.name, path=path, pose=scan.world_from_sensor)]
    return locate_survey(survey, told.built.reference, settings=SETTINGS), row


def _free_place(told: Told) -> tuple[int, Floats]:
    """Where a box hangs farthest from everything, wholly in one of the map's tiles: row and centre."""
    tiles, surface = told.built.tiles, told.built.reference.surface()
    lower = tiles.grid.lower(tiles.indices)
    margin = EDGE / 2 + 0.05
    steps = np.linspace(0, 1, 6)
    share = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    places = lower[:, None] + margin + share * (tiles.grid.size - 2 * margin)  # (T, 216, 3)
    distance, _ = surface.nearest(places.reshape(-1, 3))
    best = int(distance.argmax())
    assert distance[best] > EDGE / 2 * np.sqrt(3) + 0.1
    return best // len(share), places.reshape(-1, 3)[best]


def _box_surface() -> Floats:
    """A cube around 0 with a point every 2.5 cm of its faces."""
    line = np.arange(-EDGE / 2, EDGE / 2 + 0.001, 0.025)
    grid = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    return grid[np.abs(grid).max(axis=1) > EDGE / 2 - 0.001]


def test_voxel_and_tile_sizes_come_from_the_card() -> None:
    needs = Preprocessing(voxel_size=0.08, tile_size=(2.0, 2.5, 3.0), min_points=77)
    asked = PipelineSettings.model_validate(
        {"registration": {"min_fitness": 0.6, "voxel_size": 0.01}, "tiling": {"min_observed_share": 0.25}}
    )
    found = asked.for_model(needs)
    assert found.registration.voxel_size == 0.08
    assert found.tiling.tile_size == (2.0, 2.5, 3.0)
    assert found.tiling.min_points == 77
    assert found.registration.min_fitness == 0.6  # what was asked for stays
    assert found.tiling.min_observed_share == 0.25


def test_the_map_holds_every_scan_in_its_place(room: Room, told: Told) -> None:
    for outcome, scan in zip(told.built.outcomes, room.before[:2], strict=True):
        assert difference(registered(outcome).map_from_scan, scan.world_from_sensor)[0] < 0.015


def test_the_map_is_cut_into_tiles_of_512_points_and_more(told: Told) -> None:
    tiles = told.built.tiles
    assert tiles.grid.origin / 0.05 == pytest.approx(np.rint(tiles.grid.origin / 0.05))
    assert len(tiles.points) > 15
    assert min(len(points) for points in tiles.points) >= 512
    for lower, points in zip(tiles.grid.lower(tiles.indices), tiles.points, strict=True):
        assert np.all((points >= lower - 1e-6) & (points < lower + tiles.grid.size))


def test_the_same_scans_again_change_nothing(told: Told) -> None:
    counts = detect(told.survey.comparison, Counting()).counts()
    assert counts["changed"] == counts["inconsistent"] == 0
    assert counts["unchanged"] > 15


def test_a_box_moves_no_scan(told: Told, boxed: tuple[LocatedSurvey, int]) -> None:
    for with_box, plain in zip(boxed[0].outcomes, told.survey.outcomes, strict=True):
        metres, radians = difference(registered(with_box).map_from_scan, registered(plain).map_from_scan)
        assert metres < 0.002
        assert radians < 0.001


def test_a_box_adds_its_voxels_to_its_own_tile(told: Told, boxed: tuple[LocatedSurvey, int]) -> None:
    survey, row = boxed
    now, before = (
        [len(part) for part in each.comparison.tile_pairs.current] for each in (survey, told.survey)
    )
    gain = np.array(now) - np.array(before)
    voxels = (EDGE / 0.05) ** 2 * 6
    assert 0.8 * voxels < gain[row] < 1.5 * voxels
    assert np.abs(np.delete(gain, row)).max() < 0.05 * voxels


def test_a_box_changes_exactly_its_tile(boxed: tuple[LocatedSurvey, int]) -> None:
    survey, row = boxed
    changes = detect(survey.comparison, Counting())
    assert np.flatnonzero(changes.states == TileState.CHANGED).tolist() == [row]


def test_the_threshold_is_the_cards_unless_one_is_given() -> None:
    pairs = Comparison.of_tiles(row_of([1000], [1250], observed=[True]))
    assert detect(pairs, Counting()).threshold == 0.2
    assert detect(pairs, Counting()).counts()["changed"] == 1
    assert detect(pairs, Counting(), threshold=0.5).counts()["changed"] == 0
    assert detect(pairs, Counting(), threshold=0.0).threshold == 0.0


@pytest.mark.parametrize(
    ("in_doubt", "states"),
    [(False, ["unchanged", "changed", "unobserved"]), (True, ["inconsistent", "inconsistent", "unobserved"])],
)
def test_where_the_placement_is_in_doubt_no_tile_is_unchanged_or_changed(
    in_doubt: bool, states: list[str]
) -> None:
    pairs = Comparison.of_tiles(row_of([1000] * 3, [1000, 1500, 3], observed=[True, True, False]))
    changes = detect(
        pairs, Counting(), placement=SurveyPlacement(confidence=0.71, in_doubt=in_doubt), settings=SETTINGS
    )
    assert [TileState(state).label for state in changes.states] == states
    assert changes.doubtful_placement == (0.71 if in_doubt else None)


def test_the_detector_is_given_what_the_map_kept_for_it() -> None:
    detector, kept = Counting(), {"descriptors": np.zeros(3)}
    detect(Comparison.of_tiles(row_of([600], [600], observed=[True])), detector, embedding=kept)
    assert detector.embeddings == [kept]


def test_a_detector_gets_both_clouds_and_the_scans_behind_them_but_loads_none(told: Told) -> None:
    def never() -> RegisteredScan:
        raise AssertionError("nobody asked for this scan")

    reference, current = told.built.reference, told.survey.current
    comparison = compare(
        reference, current, settings=SETTINGS, reference_scans=[never] * 3, current_scans=[never]
    )
    assert comparison.reference.points is reference.points
    assert comparison.reference.normals is reference.normals
    assert comparison.current.points is current.points
    assert (len(comparison.reference.scans), len(comparison.current.scans)) == (3, 1)
    assert comparison.grid == reference.grid
    assert comparison.tiles.tolist() == told.built.tiles.indices.tolist()
    assert comparison.observed.tolist() == told.survey.comparison.observed.tolist()
    assert comparison.reference.seen is None


def test_a_survey_of_another_place_is_refused_with_every_scans_numbers(told: Told, tmp_path: Path) -> None:
    files = []
    for number, scan in enumerate(visit(random_room(11), 2, seed=5)):
        write_pcd(tmp_path / f"foreign-{number}.pcd", scan.points[::3])
        files.append(ScanFile(name=f"foreign-{number}.pcd", path=tmp_path / f"foreign-{number}.pcd"))
    with pytest.raises(NoScanAccepted, match=r"foreign-0\.pcd: .*; scan foreign-1\.pcd: ") as error:
        locate_survey(files, told.built.reference, settings=SETTINGS)
    assert error.value.code == "registration_failed"
    assert [outcome.name for outcome in error.value.outcomes] == ["foreign-0.pcd", "foreign-1.pcd"]
    for outcome in error.value.outcomes:
        assert outcome.registration is None
        assert outcome.reason
        assert outcome.fitness is not None


def test_a_foreign_scan_leaves_the_survey_as_it_is_without_it(
    told: Told, files: list[ScanFile], tmp_path: Path
) -> None:
    scan = visit(random_room(11), 1, seed=5)[0]
    write_pcd(tmp_path / "foreign.pcd", scan.points[::3])
    foreign = ScanFile(name="foreign.pcd", path=tmp_path / "foreign.pcd")
    found = locate_survey([files[0], foreign, files[1]], told.built.reference, settings=SETTINGS)
    assert [outcome.registration is not None for outcome in found.outcomes] == [True, False, True]
    assert found.current.points.tolist() == told.survey.current.points.tolist()


def test_a_survey_with_a_file_that_is_no_scan_goes_on_with_the_others_and_names_it(
    told: Told, files: list[ScanFile], tmp_path: Path
) -> None:
    broken = _broken(tmp_path)
    found = locate_survey([broken, *files], told.built.reference, settings=SETTINGS)
    assert [outcome.registration is not None for outcome in found.outcomes] == [False, True, True]
    assert str(found.outcomes[0].reason).startswith("hall 3.ply: ")
    assert found.current.points.tolist() == told.survey.current.points.tolist()


def test_a_map_with_a_file_that_is_no_scan_goes_on_with_the_others_and_names_it(
    told: Told, files: list[ScanFile], tmp_path: Path
) -> None:
    built = build_map([files[0], _broken(tmp_path), files[1]], settings=SETTINGS, processes=1)
    assert [outcome.registration is not None for outcome in built.outcomes] == [True, False, True]
    assert str(built.outcomes[1].reason).startswith("hall 3.ply: ")
    assert built.report is not None
    assert (built.report.scans, built.report.accepted, built.report.discarded) == (3, 2, 1)
    assert built.reference.points == pytest.approx(told.built.reference.points, abs=1e-4)


def test_where_no_file_is_a_scan_neither_a_map_nor_a_survey_is_made(told: Told, tmp_path: Path) -> None:
    broken = [_broken(tmp_path)]
    with pytest.raises(ScanError, match=r"^hall 3\.ply: "):
        build_map(broken, settings=SETTINGS, processes=1)
    with pytest.raises(ScanError, match=r"^hall 3\.ply: "):
        locate_survey(broken, told.built.reference, settings=SETTINGS)


def _broken(folder: Path) -> ScanFile:
    (folder / "x").write_bytes(b"ply\nbut no more")
    return ScanFile(name="hall 3.ply", path=folder / "x")


def test_a_map_too_thin_for_a_tile_says_how_many_points_one_needs(files: list[ScanFile]) -> None:
    dense = SETTINGS.model_copy(
        update={"tiling": SETTINGS.tiling.model_copy(update={"min_points": 1_000_000})}
    )
    with pytest.raises(NothingToTile, match="no tile holds 1000000 points") as error:
        build_map(files[:1], settings=dense, processes=1)
    assert [outcome.registration is not None for outcome in error.value.outcomes] == [True]


def test_the_report_of_a_map_names_its_reference_and_its_registrations(told: Told) -> None:
    report = told.built.report
    assert report is not None
    assert (report.scans, report.accepted, report.pairs_possible, report.pairs_tried) == (2, 2, 1, 1)
    assert (report.pairs_accepted, report.pairs_contradicted) == (1, 0)
    assert report.reference in (0, 1)
    assert [(edge.target, edge.source) for edge in told.built.kept] == [(0, 1)]
    assert report.mean_fitness == told.built.kept[0].fitness
    assert (report.std_fitness, report.std_rmse) == (0.0, 0.0)
    assert report.document()["calls_saved"] == 0.0


STAGES = {
    "of_map": ["reading", "registering", "refining", "fusing", "tiling"],
    "of_survey": ["registering", "refining", "tiling"],
}


@pytest.mark.parametrize("half", STAGES)
def test_each_stage_is_told_from_beginning_to_end_and_never_falls(told: Told, half: str) -> None:
    reports: list[tuple[str, float]] = getattr(told, half)
    assert list(dict.fromkeys(stage for stage, _ in reports)) == STAGES[half]
    for stage in STAGES[half]:
        shares = [share for name, share in reports if name == stage]
        assert shares == sorted(shares)
        assert 0 <= shares[0] < 1
        assert shares[-1] == 1.0


def test_a_survey_of_one_scan_has_nothing_to_refine(told: Told, files: list[ScanFile]) -> None:
    stages: list[str] = []
    locate_survey(
        files[:1],
        told.built.reference,
        settings=SETTINGS,
        progress=lambda stage, share: stages.append(stage),
    )
    assert list(dict.fromkeys(stages)) == ["registering", "tiling"]


def test_a_dismissal_stops_a_survey_within_one_iteration(told: Told, files: list[ScanFile]) -> None:
    reports: list[str] = []

    def dismissed(stage: str, share: float) -> None:
        reports.append(stage)
        if len(reports) == 4:
            raise Cancelled("the job was dismissed")

    with pytest.raises(Cancelled):
        locate_survey(files, told.built.reference, settings=SETTINGS, progress=dismissed)
    assert reports == ["registering"] * 4
