"""`spicd-worker`: files in, files and words out."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support import toy
from tests.support.models import make_untrained
from tests.support.two_visits import free_place
from worker.benchmarks.plots import draw_curves
from worker.cli import detect, main, register, terminal
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import inverse, transformed
from worker.detectors.card import MODEL_STORE
from worker.pipeline.registration.diagnosis import Diagnosis
from worker.pipeline.registration.results import RegistrationResult, ScanRejected, ScanResult
from worker.progress import Progress
from worker.simulation.scenes import random_room, rigid
from worker.simulation.scenes.furniture import crate
from worker.simulation.training_set import TrainingSetSettings
from worker.simulation.visits import visit
from worker.training.dataset import TileSet, load_tiles, save_tiles
from worker.training.settings import PAPER, TrainSettings


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    make_untrained(folder / "spicd-net" / "1")
    return folder


@pytest.fixture(autouse=True)
def by_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a test names no model, take the one that `store` has, and not the release's choice."""
    monkeypatch.setenv("SPICD_MODEL", "spicd-net/1")


@pytest.fixture
def room() -> np.ndarray:
    """(N, 3) floor and walls of 4 x 3 x 2.5 m at 3 cm with a box in a corner; nothing is symmetric."""
    rng = np.random.default_rng(0)

    def sheet(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
        size = np.array(high) - low
        area = np.prod(size[size > 0])
        return low + rng.random((int(area * 2500), 3)) * size

    walls = [sheet((0, 0, 0), (0, 3, 2.5)), sheet((4, 0, 0), (4, 3, 2.5)), sheet((0, 0, 0), (4, 0, 2.5))]
    box = [
        sheet((0, 2, 0.8), (0.7, 3, 0.8)),
        sheet((0.7, 2, 0), (0.7, 3, 0.8)),
        sheet((0, 2, 0), (0.7, 2, 0.8)),
    ]
    return np.concatenate([sheet((0, 0, 0), (4, 3, 0)), *walls, *box])


@pytest.fixture
def files(tmp_path: Path, room: np.ndarray) -> tuple[str, str]:
    """The room, and a later scan of it, 8 cm and 2 degrees off, which saw nothing beyond x = 2 m."""
    pose = rigid(0.08, -0.05, 0.0, yaw=2.0)
    seen = room[room[:, 0] < 2.0] @ pose[:3, :3].T + pose[:3, 3]
    write_pcd(tmp_path / "before.pcd", room)
    noisy = seen + np.random.default_rng(1).normal(0, 0.003, seen.shape)
    write_pcd(tmp_path / "after.pcd", noisy.astype(np.float32))
    return str(tmp_path / "before.pcd"), str(tmp_path / "after.pcd")


def run(*words: str) -> int:
    try:
        main(list(words))
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.mark.slow
def test_detect_writes_features_a_cloud_and_a_picture_and_tells_where(
    files: tuple[str, str], store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run("detect", *files, "--out", str(out), "--model-store", str(store), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    collection = json.loads((out / "tiles.geojson").read_text())
    assert collection["crs"]["properties"]["name"].startswith("ENGCRS")
    features = collection["features"]
    states = Counter(feature["properties"]["state"] for feature in features)
    assert told["counts"]["tiles"] == len(features) == sum(told["counts"].values()) // 2 > 0
    assert {state: count for state, count in told["counts"].items() if state in states} == states
    for feature in features:
        about = feature["properties"]
        if about["center"][0] > 3:  # not seen again
            assert (about["state"], about["score"]) == ("unobserved", None)
        assert about["center"][2] == pytest.approx((about["z_min"] + about["z_max"]) / 2)
        corners = np.array(feature["geometry"]["coordinates"][0])
        np.testing.assert_allclose(
            corners[:4].mean(axis=0), [*about["center"][:2], about["z_min"]], atol=1e-6
        )
    assert read_scan(Path(told["files"]["cloud"])).points[:, 0].max() < 2.2
    assert Path(told["files"]["picture"]).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize(("model", "threshold"), [("c2c/1", 0.5), (toy.MODEL, 0.25)])
def test_detect_takes_any_detector_of_the_store_by_its_name(
    files: tuple[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    model: str,
    threshold: float,
) -> None:
    store = tmp_path / "models"
    shutil.copytree(MODEL_STORE / "c2c", store / "c2c")
    toy.install(monkeypatch, store)
    words = ["--out", str(tmp_path / "out"), "--model-store", str(store), "--model", model, "--json"]
    assert run("detect", *files, *words) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["model"], told["threshold"]) == (model, threshold)
    assert 0 < told["counts"]["unobserved"] < told["counts"]["tiles"]
    features = json.loads((tmp_path / "out" / "tiles.geojson").read_text())["features"]
    assert {feature["properties"]["model"] for feature in features} == {model}


@pytest.mark.slow
def test_detect_says_by_how_much_the_later_scan_was_off(
    files: tuple[str, str], store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("detect", *files, "--out", str(tmp_path), "--model-store", str(store), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["placement"]["state"] == "confirmed"
    found = told["current"][0]
    assert (found["accepted"], found["reason"], found["warnings"]) == (True, None, [])
    undone = np.array(found["map_from_scan"]) @ rigid(0.08, -0.05, 0.0, yaw=2.0)
    np.testing.assert_allclose(undone, np.eye(4), atol=0.01)


@pytest.mark.slow
def test_every_seen_tile_is_changed_at_threshold_0_and_none_at_1(
    files: tuple[str, str], store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = {}
    for threshold in ("0", "1"):
        words = ["--out", str(tmp_path), "--model-store", str(store), "--threshold", threshold, "--json"]
        assert run("detect", *files, *words) == 0
        told = json.loads(capsys.readouterr().out)
        changed[threshold] = told["counts"]["changed"]
        assert len(told["changed"]) == told["counts"]["changed"]
    assert changed["0"] == told["counts"]["tiles"] - told["counts"]["unobserved"] > 0
    assert changed["1"] == 0


@pytest.mark.slow
def test_more_reference_files_are_part_of_the_map(
    files: tuple[str, str], store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--reference", files[0], "--out", str(tmp_path), "--model-store", str(store)]
    assert run("detect", *files, *words) == 0
    shown = capsys.readouterr().out
    assert len(re.findall("before.pcd", shown)) == 2
    assert re.search(r"\d+ tiles, \d+ unchanged, \d+ changed", shown)


@pytest.mark.parametrize(
    ("spoilt", "sentence"),
    [
        ("missing.pcd", "missing.pcd: No such file"),
        ("text.pcd", "neither PLY, PCD, E57 nor LAS"),
    ],
)
def test_a_bad_file_ends_in_one_sentence_that_names_it(
    files: tuple[str, str],
    store: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    spoilt: str,
    sentence: str,
) -> None:
    (tmp_path / "text.pcd").write_text("hello")
    words = ["detect", files[0], str(tmp_path / spoilt), "--model-store", str(store)]
    assert run(*words, "--out", str(tmp_path / "out")) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.strip().splitlines()) == 1
    assert spoilt in told.err
    assert sentence in told.err
    assert not (tmp_path / "out").exists()


def test_the_summary_prints_names_that_look_like_markup_as_they_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scan: dict[str, Any] = {
        "accepted": False,
        "fitness": None,
        "rmse": None,
        "reason": "no_fit",
        "detail": "too far",
        "warnings": [],
    }
    result = {
        "model": "spicd-net/1",
        "threshold": 0.5,
        "placement": {"state": "confirmed", "confidence": 0.98},
        "counts": {"tiles": 0},
        "reference": [{**scan, "name": "[old]/hall.pcd"}],
        "current": [{**scan, "name": "a[/]b.pcd"}],
        "changed": [],
        "objects": None,
        "moving": None,
        "files": {"tiles": "[new]/tiles.geojson"},
    }
    terminal.show(result, detect.summary)
    shown = capsys.readouterr().out
    assert all(name in shown for name in ("[old]/hall.pcd", "a[/]b.pcd", "[new]/tiles.geojson"))


def test_the_summary_says_that_the_placement_is_in_doubt(capsys: pytest.CaptureFixture[str]) -> None:
    odd = {"reason": "wrong_scale", "detail": "its scale is 1.012", "numbers": {"scale": 1.012}}
    result = {
        "model": "spicd-net/1",
        "threshold": 0.5,
        "placement": {"state": "in_doubt", "confidence": 0.71},
        "counts": {"tiles": 4, "inconsistent": 4},
        "reference": [],
        "current": [
            {
                "name": "b.pcd",
                "accepted": True,
                "fitness": 0.9,
                "rmse": 0.02,
                "reason": None,
                "detail": None,
                "warnings": [odd],
            }
        ],
        "changed": [],
        "objects": None,
        "moving": None,
        "files": {},
    }
    terminal.show(result, detect.summary)
    shown = capsys.readouterr().out
    assert "placement in doubt (confidence 0.71): no tile counts as unchanged or changed" in shown
    assert "wrong scale: its scale is 1.012" in shown


@pytest.mark.slow
@pytest.mark.parametrize("as_json", [True, False])
def test_register_says_why_a_scan_has_no_place(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], as_json: bool
) -> None:
    """A bare floor leaves three motions free."""
    floor = np.random.default_rng(2).uniform((0, 0, 0), (4, 3, 0), (30_000, 3)).astype(np.float32)
    write_pcd(tmp_path / "floor.pcd", floor)
    words = ["--json"] if as_json else []
    assert run("register", files[0], str(tmp_path / "floor.pcd"), *words) == 1
    told = capsys.readouterr()
    assert "floor.pcd" in told.err
    if as_json:
        result = json.loads(told.out)
        assert (result["accepted"], result["reason"]) == (False, "degenerate")
        assert result["detail"] == told.err.strip()
        assert result["numbers"]
        assert (result["candidates"], result["warnings"]) == (None, [])
    else:
        assert re.search(r"reason +. degenerate", told.out)


def test_a_refusal_lists_the_candidates_and_an_acceptance_its_warnings(
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = rigid(2.5, 0, 0, yaw=180)
    why = Diagnosis(reason="ambiguous", detail="two", numbers={"margin": 0.012}, poses=(np.eye(4), other))
    result = register.document(ScanResult.rejected("b.pcd", ScanRejected(why, fitness=0.9)), 1.0)
    assert (result["reason"], result["fitness"]) == ("ambiguous", 0.9)
    np.testing.assert_allclose(result["candidates"], [np.eye(4), other])
    terminal.show(result, register._refusal_table)
    shown = capsys.readouterr().out
    assert all(said in shown for said in ("margin 0.012", "candidate 2", "2.5000"))
    odd = Diagnosis(reason="wrong_scale", detail="its scale is 1.012", numbers={"scale": 1.012})
    good = RegistrationResult(
        map_from_scan=np.eye(4),
        sensor_origin=None,
        fitness=0.9,
        inlier_rmse=0.02,
        overlap=0.8,
        two_way_inlier_ratio=0.9,
        from_global_search=False,
        uncertainty=None,
    )
    result = register.document(ScanResult.accepted("b.pcd", good, warnings=(odd,), confidence=0.97), 1.0)
    assert result["warnings"][0]["numbers"] == {"scale": 1.012}
    terminal.show(result, register._table)
    shown = capsys.readouterr().out
    assert all(said in shown for said in ("0.97", "wrong scale: its scale is 1.012"))


@pytest.mark.slow
def test_detect_tells_objects_where_the_model_scores_voxels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A room before and after a crate is put there, seen from one place; the frame is the first scan's."""
    room = random_room(5)
    (before,) = visit(room, 1, seed=1)
    x, y, _ = before.world_from_sensor[:3, 3]
    later, change = room.with_added("crate", crate(0.7, 0.5, 0.6).at(*free_place(room, around=(x, y))))
    (after,) = visit(later, (before.world_from_sensor,), seed=2)
    for name, scan in (("a", before), ("b", after)):
        write_pcd(tmp_path / f"{name}.pcd", scan.points)
    words = ["--out", str(tmp_path), "--model", "voxel-rule/1", "--json"]
    assert run("detect", str(tmp_path / "a.pcd"), str(tmp_path / "b.pcd"), *words) == 0
    told = json.loads(capsys.readouterr().out)
    largest = told["objects"][0]
    assert largest["kind"] == "appeared"
    assert change.after is not None
    there = transformed(change.after.mean(axis=0)[None], inverse(before.world_from_sensor))[0]
    assert largest["now"]["center"][:2] == pytest.approx(there[:2], abs=0.35)
    features = json.loads((tmp_path / "objects.geojson").read_text())["features"]
    assert [feature["properties"]["number"] for feature in features] == [
        thing["number"] for thing in told["objects"]
    ]
    tile = json.loads((tmp_path / "tiles.geojson").read_text())["features"][0]["properties"]
    assert 0 <= tile["observed_share"] <= 1
    terminal.show(told, detect.summary)
    assert "appeared" in capsys.readouterr().out


def test_the_summary_lists_objects_with_how_they_moved(capsys: pytest.CaptureFixture[str]) -> None:
    place = {"center": [1.0, 2.0, 0.5], "size": [0.5, 0.4, 0.9], "height_over_floor": None}
    moved: dict[str, Any] = {
        "number": 1,
        "kind": "moved",
        "now": place,
        "before": place,
        "motion": {"translation": [0.3, 0.4, 0.0], "yaw": 1.5707963},
        "probability": 0.91,
    }
    round_ = {**moved, "number": 2, "motion": {**moved["motion"], "yaw": None}}
    result = {
        "model": "voxel-rule/1",
        "threshold": 0.5,
        "placement": {"state": "confirmed", "confidence": 0.98},
        "counts": {"tiles": 0},
        "reference": [],
        "current": [],
        "changed": [],
        "objects": [moved, round_, {**moved, "number": 3, "kind": "appeared", "motion": None}] * 8,
        "moving": 2,
        "files": {},
    }
    terminal.show(result, detect.summary)
    shown = capsys.readouterr().out
    for said in (
        "0.50 m, 90°",
        "... and 4 more objects",
        "16 moved, 8 appeared; 2 more moved during a visit",
    ):
        assert said in shown


def test_a_model_that_is_not_there_is_named(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("detect", *files, "--model-store", str(tmp_path), "--model", "other/9") == 1
    assert "other/9" in capsys.readouterr().err


@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch) -> list[tuple[TrainSettings, Path, Path]]:
    """What was to be trained, instead of training."""
    asked: list[tuple[TrainSettings, Path, Path]] = []

    def remember(
        settings: TrainSettings, dataset: Path, out: Path, progress: Progress, *, on_epoch: object
    ) -> Path:
        assert on_epoch is draw_curves
        asked.append((settings, dataset, out))
        return out / "best.pt"

    monkeypatch.setattr("worker.training.trainer.train", remember)
    return asked


@pytest.mark.slow
def test_train_simulates_the_set_that_is_not_there_and_trains_on_it(
    tmp_path: Path, trainings: list[tuple[TrainSettings, Path, Path]]
) -> None:
    assert run("train", str(tmp_path), "--rooms", "1", "--offices", "0", "--corridors", "0") == 0
    assert [(dataset, out) for _, dataset, out in trainings] == [(tmp_path / "tiles.npz", tmp_path)]
    tiles = load_tiles(tmp_path / "tiles.npz")
    assert len(tiles) > 5
    assert set(tiles.buildings) == {0}


def test_train_rebuilds_as_many_maps_of_each_building_as_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def build(settings: TrainingSetSettings, progress: Progress) -> TileSet:
        asked.append(settings)
        raise ValueError("asked for")

    monkeypatch.setattr("worker.simulation.training_set.build_training_set", build)
    assert run("train", str(tmp_path), "--rooms", "1", "--rebuilds", "7") == 1
    assert [(settings.rooms, settings.walks.rebuilds) for settings in asked] == [(1, 7)]


def test_train_keeps_defaults_but_for_what_was_given(
    tmp_path: Path,
    trainings: list[tuple[TrainSettings, Path, Path]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    _save_small_set(tmp_path / "tiles.npz")
    words = ["--minutes", "7", "--batch", "8", "--density", "0.05", "0.3", "--device", "cpu"]
    assert run("train", str(tmp_path / "run"), "--tiles", str(tmp_path / "tiles.npz"), *words) == 0
    default = TrainSettings()
    wanted = replace(default, minutes=7, batch=8, pairs=replace(default.pairs, density=(0.05, 0.3)))
    assert trainings == [(wanted, tmp_path / "tiles.npz", tmp_path / "run")]
    assert "best.pt" in capsys.readouterr().out


def test_train_paper_is_the_papers_preset(
    tmp_path: Path, trainings: list[tuple[TrainSettings, Path, Path]]
) -> None:
    _save_small_set(tmp_path / "tiles.npz")
    words = ["--paper", "--epochs", "3", "--device", "cpu"]
    assert run("train", str(tmp_path), *words) == 0
    assert [settings for settings, _, _ in trainings] == [replace(PAPER, epochs=3)]


def test_train_refuses_to_simulate_over_a_set_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _save_small_set(tmp_path / "tiles.npz")
    before = (tmp_path / "tiles.npz").read_bytes()
    assert run("train", str(tmp_path), "--rooms", "1", "--epochs", "1") == 1
    assert "tiles.npz is there already" in capsys.readouterr().err
    assert (tmp_path / "tiles.npz").read_bytes() == before


def _save_small_set(path: Path) -> None:
    """Twenty tiles in a row, far enough apart to be different places."""
    rng = np.random.default_rng(0)
    clouds = tuple((rng.uniform(-0.5, 0.5, (600, 3)) * (1.5, 1.5, 0.2)).astype(np.float32) for _ in range(20))
    tiles = TileSet(
        points_a=clouds,
        points_b=clouds,
        observations=(),
        centres=np.array([[4.0 * number, 0, 0] for number in range(20)]),
        buildings=np.zeros(20, np.int32),
        tile_size=(1.5, 1.5, 1.0),
        source="a test",
    )
    save_tiles(tiles, path)
