"""The demo: what it simulates, how it judges, and that it ends."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tests.support.models import make_untrained
from worker.cloud.tiling import TileGrid
from worker.demo.judgement import Verdict, grid_of, judge, placement_line, show_judgement
from worker.demo.run import run
from worker.demo.service import DemoFailed, ServiceChild
from worker.demo.story import OFFICE, DemoSettings, Story, edits, tell
from worker.simulation.scenes import small_office
from worker.simulation.truth import TileTruth

MANIFEST = {
    "tile_origin": [0.0, 0.0, 0.0],
    "tile_size": [1.5, 1.5, 1.0],
    "n_tiles_grid": [7, 6, 3],
    "tile_lowest_idx": [0, 0, 0],
}


@pytest.fixture(scope="module")
def story() -> Story:
    return tell(DemoSettings(stops=(3, 2), duration_s=0.5))


def test_every_piece_that_comes_or_is_moved_finds_a_free_place() -> None:
    before = small_office(OFFICE)
    for edit in edits(before):
        old = {item.name: item for item in edit.before.objects}
        for item in edit.after.objects:
            if item.name not in old or item.mesh is not old[item.name].mesh:
                assert edit.before.is_free(item.mesh.bounds, ignoring=item.name), edit.sentence


def test_all_but_the_first_prior_are_off(story: Story) -> None:
    np.testing.assert_array_equal(story.first[0].prior, story.first[0].world_from_sensor)
    for scan in (*story.first[1:], *story.second):
        assert 0.005 < np.linalg.norm(scan.prior[:2, 3] - scan.world_from_sensor[:2, 3]) < 0.6


def test_the_truth_of_all_edits_is_that_of_each_together(story: Story) -> None:
    grid = grid_of(MANIFEST)
    whole, each = story.truth(grid), story.truth_of_each(grid)
    assert len(each) == 6
    assert whole.cells.sum() == pytest.approx(sum(one.cells.sum() for one in each), rel=0.1)
    assert whole.changed.sum() >= 1


def truth(*cells: tuple[int, int]) -> TileTruth:
    """A row of five tiles; (tile, changed cells) of one kind."""
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(5, 1, 1))
    counts = np.zeros((5, 1, 1, 3), np.int32)
    for tile, count in cells:
        counts[tile, 0, 0, 0] = count
    return TileTruth(grid=grid, cells=counts, min_cells=40)


def feature(tile: int, state: str, score: float | None) -> dict[str, Any]:
    about = {
        "tile_id": f"tile_{tile:03d}_000_000",
        "tile_index": [tile, 0, 0],
        "center": [1.5 * tile + 0.75, 0.75, 0.5],
        "state": state,
        "score": score,
    }
    return {"properties": about}


@pytest.fixture
def judged() -> Any:
    """Tile 0 hit, 1 missed, 2 a false alarm, 3 not seen; 4 is no tile of the map. The crate is in 0 and 1."""
    features = [
        feature(0, "changed", 0.9),
        feature(1, "inconsistent", 0.2),
        feature(2, "changed", 0.6),
        feature(3, "unobserved", None),
    ]
    crate, plant = truth((0, 100), (1, 50), (2, 39)), truth((1, 10), (3, 80), (4, 80))
    both = truth((0, 100), (1, 60), (2, 39), (3, 80), (4, 80))
    return judge(features, both, [("crate added", crate), ("plant removed", plant)])


def test_each_tile_is_judged_against_the_truth(judged: Any) -> None:
    assert [tile.verdict for tile in judged.tiles] == [
        Verdict.HIT,
        Verdict.MISS,
        Verdict.FALSE_ALARM,
        Verdict.UNOBSERVED,
    ]
    assert [tile.truth for tile in judged.tiles] == ["crate added", "crate added", None, "plant removed"]
    assert judged.outside == 1


def test_an_edit_counts_the_tiles_that_it_changed_and_those_found(judged: Any) -> None:
    assert [(edit.sentence, edit.tiles, edit.found) for edit in judged.edits] == [
        ("crate added", 2, 1),
        ("plant removed", 1, 0),
    ]


def test_misses_and_false_alarms_are_told(judged: Any) -> None:
    page = io.StringIO()
    show_judgement(Console(file=page, width=160), judged)
    told = page.getvalue()
    assert "1 hits, 1 missed, 1 false alarms, 0 rightly quiet" in told
    assert "1 changed tiles were not seen well enough" in told
    assert "1 more changed where the map holds too few points" in told
    for tile in range(4):
        assert f"tile_{tile:03d}_000_000" in told


def test_the_scan_that_sets_the_frame_has_no_fitness_and_needs_none(story: Story) -> None:
    exact = story.first[0].world_from_sensor.tolist()
    outcomes = [{"accepted": True, "fitness": None, "map_from_scan": exact}]
    line = placement_line("map", outcomes, story.first[:1])
    assert line.startswith("map: 1 of 1 scans placed; off by 0.0 cm")


def test_placement_is_measured_against_the_true_poses(story: Story) -> None:
    found = story.first[1].world_from_sensor.copy()
    found[0, 3] += 0.02
    exact = story.first[2].world_from_sensor
    outcomes = [
        {"accepted": False},
        {"accepted": True, "fitness": 0.8, "map_from_scan": found.tolist()},
        {"accepted": True, "fitness": 0.9, "map_from_scan": exact.tolist()},
    ]
    line = placement_line("map", outcomes, story.first)
    assert line.startswith("map: 2 of 3 scans placed, median fitness 0.85; off by 1.0 cm and 0.0°")
    assert "at worst 2.0 cm and 0.0°" in line


def test_a_service_that_cannot_start_is_told_with_its_own_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPICD_DEVICE", "abacus")
    with (
        pytest.raises(DemoFailed, match="SPICD_DEVICE"),
        ServiceChild(tmp_path / "data", tmp_path / "log") as child,
    ):
        child.await_ready()


def test_a_short_demo_leaves_its_results_and_no_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_untrained(tmp_path / "models" / "spicd-net" / "1")
    monkeypatch.setenv("SPICD_MODEL_STORE", str(tmp_path / "models"))
    (tmp_path / "mine.txt").write_text("kept")
    page = io.StringIO()
    settings = DemoSettings(stops=(2, 2), prior_error=(0.02, 0.5))
    result = run(
        tmp_path, settings, out_console=Console(file=page, width=160), err_console=Console(file=io.StringIO())
    )
    assert result.map["status"] == result.survey["status"] == "ready"
    assert len(result.judgement.tiles) == result.survey["counts"]["tiles"]
    assert sum(result.judgement.counts().values()) == result.survey["counts"]["tiles"]
    for what, start in (("changes", b'{"type":"Feature'), ("cloud", b"ply\n"), ("picture", b"\x89PNG")):
        assert result.files[what].read_bytes().startswith(start)
        assert str(result.files[what]) in page.getvalue()
    assert (tmp_path / "mine.txt").exists()
    assert _started_for(tmp_path) == []


def _started_for(folder: Path) -> list[str]:
    """Command lines that name the folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = process.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it ended meanwhile
            continue
        if str(folder / "demo-data") in words:
            found.append(words)
    return found
