"""All models of a store are timed on the same tiles, in turn, beside the baselines."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from worker.benchmarks.card_figures import speed_figures
from worker.benchmarks.detector_speed import YARDSTICK, SpeedSettings, measure, tables, times_of
from worker.detectors.card import MODEL_STORE
from worker.detectors.precision import has_bfloat16
from worker.detectors.store import open_card, write_card


@pytest.mark.slow
def test_every_model_is_timed_on_as_many_tiles_and_goes_on_its_card(tmp_path: Path) -> None:
    cards = {name: open_card(MODEL_STORE, name) for name in ("c2c/1", "voxel-rule/1")}
    for name, card in cards.items():
        (tmp_path / name).mkdir(parents=True)
        write_card(tmp_path / name, card)
    shutil.copytree(MODEL_STORE / "spicd-net/1", tmp_path / "spicd-net/1")
    (tmp_path / "odd" / "1").mkdir(parents=True)
    odd = cards["c2c/1"].model_copy(update={"name": "odd", "detector": "nobody's"})
    write_card(tmp_path / "odd" / "1", odd)
    told = measure(SpeedSettings(scans=4, tiles=6, repeats=1, model_store=tmp_path))
    rows = {row["model"]: row for row in told["methods"]}
    assert {*cards, YARDSTICK, "M3C2-approx"} <= set(rows)
    assert rows["c2c/1"]["tiles"] == told["data"]["tiles"] == 6
    assert rows["voxel-rule/1"]["tiles"] > 0
    assert rows[YARDSTICK]["times_c2c"] == rows[YARDSTICK]["times_c2c_of_processor"] == 1.0
    assert rows["c2c/1"]["precision"] is None
    held = has_bfloat16(torch.device("cpu"))  # the card says that scores hold
    assert rows["spicd-net/1"]["precision"] == ("bfloat16" if held else "float32")
    assert ("spicd-net/1 in float32" in rows) == held
    assert [words for words in told["left_out"] if "nobody's" in words]
    json.dumps(told, allow_nan=False)
    section = speed_figures({"command": "speed", **told}, cards["c2c/1"])
    assert section["seconds"] == rows["c2c/1"]["seconds"]
    assert "M3C2-approx" in section["baselines"]
    assert tables(told).renderables


def test_ways_take_turns() -> None:
    order: list[str] = []
    seconds = times_of({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, repeats=2)
    assert order == ["a", "b", "a", "b"]
    assert [len(times) for times in seconds.values()] == [2, 2]
