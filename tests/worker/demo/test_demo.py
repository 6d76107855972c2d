"""The demo: what it simulates, how it judges, and that it ends."""

from __future__ import annotations

import io
import json
import re
import sys
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from rich.console import Console

from tests.support.models import make_untrained
from worker.cli import terminal
from worker.cloud.tiling import TileGrid
from worker.demo.judgement import Verdict, grid_of, judge, placement_line, show_judgement
from worker.demo.run import run
from worker.demo.service import DemoFailed, ServiceChild
from worker.demo.story import OFFICE, DemoSettings, Story, edits, tell
from worker.demo.things import Find, ThingsJudgement, judge_things, show_things
from worker.detectors.card import MODEL_STORE
from worker.simulation.scenes import Change, small_office
from worker.simulation.scenes.scene import ChangeKind
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


def test_a_tile_off_the_maps_grid_is_not_taken_for_its_last_one() -> None:
    whole = truth((4, 80))
    judged = judge(
        [feature(5, "changed", 0.9), feature(-1, "unchanged", 0.1)], whole, [("crate added", whole)]
    )
    assert [tile.verdict for tile in judged.tiles] == [Verdict.FALSE_ALARM, Verdict.RIGHT]


def thing(number: int, kind: str, *, now: float | None = None, before: float | None = None) -> dict[str, Any]:
    """A feature of an object at x metres along a wall."""
    places = [
        None if x is None else {"center": [x, 0.0, 0.5], "size": [0.8, 0.5, 0.8]} for x in (now, before)
    ]
    motion = {"translation": [1.0, 0.0, 0.0], "yaw_degrees": -25.0} if kind == "moved" else None
    return {
        "properties": {
            "number": number,
            "kind": kind,
            "now": places[0],
            "before": places[1],
            "motion": motion,
        }
    }


def edit(kind: ChangeKind, *, before: float | None = None, after: float | None = None) -> Change:
    boxes = [
        None if x is None else np.array([[x - 0.4, -0.25, 0.0], [x + 0.4, 0.25, 0.8]])
        for x in (before, after)
    ]
    return Change(kind=kind, name=kind, before=boxes[0], after=boxes[1])


@pytest.fixture
def told() -> ThingsJudgement:
    """A crate added at 0 m and told, a table moved from 4 to 6 m and told in pieces, a plant missed, one unseen."""
    return judge_things(
        [
            thing(1, "appeared", now=0.2),
            thing(2, "appeared", now=6.5),
            thing(3, "disappeared", before=4.0),
            thing(4, "moved", now=21.0, before=20.0),
        ],
        [
            ("crate added", edit("add", after=0.0), 100),
            ("table moved", edit("move", before=4.0, after=6.0), 100),
            ("plant removed", edit("remove", before=10.0), 100),
            ("bin removed", edit("remove", before=12.0), 3),
        ],
    )


def test_what_was_done_is_found_told_otherwise_missed_or_out_of_sight(told: ThingsJudgement) -> None:
    assert [one.find for one in told.things] == [Find.FOUND, Find.OTHERWISE, Find.MISSED, Find.UNSEEN]
    assert [[one["number"] for one in each.told] for each in told.things] == [[1], [2, 3], [], []]
    assert [one["number"] for one in told.made_up] == [4]


def test_a_thing_that_came_is_not_what_was_taken_away_there() -> None:
    judged = judge_things(
        [thing(1, "appeared", now=3.0)], [("plant removed", edit("remove", before=3.0), 100)]
    )
    assert judged.things[0].find is Find.MISSED
    assert len(judged.made_up) == 1


def test_the_story_is_told_by_objects(told: ThingsJudgement) -> None:
    page = io.StringIO()
    show_things(Console(file=page, width=200), told, moving=2)
    shown = page.getvalue()
    for said in (
        "1 appeared: 0.8 x 0.5 x 0.8 m at (0.20, 0.00)",
        "2 appeared: 0.8 x 0.5 x 0.8 m at (6.50, 0.00); 3 disappeared",
        "4 moved by 1.0 m, turned by 25°",
        "2 of 4 changes found, 1 false alarms",
        "1 could not be seen by the robot",
        "2 things moved while the robot looked",
    ):
        assert said in shown


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
    settings = DemoSettings(stops=(2, 2), prior_error=(0.02, 0.5), model="spicd-net/1")
    result = run(
        tmp_path, settings, out_console=Console(file=page, width=160), err_console=Console(file=io.StringIO())
    )
    assert result.map["status"] == result.survey["status"] == "ready"
    assert result.things is None
    assert len(result.judgement.tiles) == result.survey["counts"]["tiles"]
    assert sum(result.judgement.counts().values()) == result.survey["counts"]["tiles"]
    for what, start in (("changes", b'{"type":"Feature'), ("cloud", b"ply\n"), ("picture", b"\x89PNG")):
        assert result.files[what].read_bytes().startswith(start)
        assert str(result.files[what]) in page.getvalue()
    last = page.getvalue().splitlines()[-1]
    assert last.startswith("look ")
    assert f"spicd up --data-dir {tmp_path / 'demo-data'}, then http://127.0.0.1:8000/" in last
    assert last.endswith(f"/#map=office&survey={result.survey['survey_id']}")
    assert (tmp_path / "mine.txt").exists()
    assert _started_for(tmp_path) == []


def test_a_demo_with_voxels_tells_objects_and_shows_them_until_the_viewer_was_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPICD_MODEL_STORE", str(MODEL_STORE))
    page, shown = io.StringIO(), []

    def looked_at(_: ServiceChild) -> None:
        (address,) = re.findall(r"look +(http://\S+)", page.getvalue())
        shown.append((address, httpx.get(address, headers={"Accept": "text/html"})))

    monkeypatch.setattr(ServiceChild, "await_end", looked_at)
    settings = DemoSettings(stops=(2, 2), prior_error=(0.02, 0.5), model="voxel-rule/1")
    out, err = Console(file=page, width=160), Console(file=io.StringIO())
    result = run(tmp_path, settings, out_console=out, err_console=err, look=True)
    ((address, answer),) = shown
    assert address.endswith(f"/#map=office&survey={result.survey['survey_id']}")
    assert answer.headers["Content-Type"].startswith("text/html")
    assert _started_for(tmp_path) == []
    assert result.survey["model"] == "voxel-rule/1"
    assert result.things is not None
    assert len(result.things.things) == 6
    told = sum(result.survey["objects"].values())
    assert told == len(json.loads(result.files["objects"].read_text())["features"])
    assert "of 6 changes found" in page.getvalue()


def test_ctrl_c_ends_the_looking_and_a_service_that_ends_by_itself_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    with ServiceChild(tmp_path / "data", tmp_path / "log") as child:
        child.await_ready()
        with monkeypatch.context() as patch:
            patch.setattr(child._started, "wait", interrupted)
            child.await_end()
        assert child._started.poll() is None
        child._started.terminate()
        with pytest.raises(DemoFailed, match="the service ended"):
            child.await_end()


def test_nobody_looks_where_there_is_no_terminal_or_a_machine_at_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    assert not terminal.is_attended()
    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    assert terminal.is_attended()
    monkeypatch.setenv("CI", "true")
    assert not terminal.is_attended()


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
