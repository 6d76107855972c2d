"""What documents share: spreads of values, and files that are whole or not there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from worker.benchmarks.documents import pose_spread, spread, write_json


def test_a_spread_has_the_statistics_asked_for_and_leaves_nan_out():
    assert spread([3.0, np.nan, 1.0, 8.0], "median", "worst") == {"median": 3.0, "worst": 8.0}
    assert spread(np.arange(101), "least", "95%", "most") == {"least": 0.0, "95%": 95.0, "most": 100.0}
    assert spread([1 / 3], "median", digits=2) == {"median": 0.33}
    assert spread([np.nan], "median") is None


def test_pose_errors_are_told_in_centimetres_and_degrees():
    told = pose_spread([(0.01, 0.0), (0.03, np.pi)], "worst")
    assert told == {"centimetres": {"worst": 3.0}, "degrees": {"worst": pytest.approx(180.0)}}
    assert pose_spread([], "worst") == {"centimetres": None, "degrees": None}


def test_a_document_is_written_whole_into_a_new_folder_or_not_at_all(tmp_path: Path):
    path = tmp_path / "new" / "figures.json"
    write_json(path, {"f1": 0.5})
    assert json.loads(path.read_text()) == {"f1": 0.5}
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"f1": float("nan")})
    assert [file.name for file in path.parent.iterdir()] == ["figures.json"]
    assert json.loads(path.read_text()) == {"f1": 0.5}
