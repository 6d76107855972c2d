"""How far scores move in bfloat16 is measured on two visits, recorded on the card, and believed of these weights alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from worker.benchmarks.precision import PrecisionSettings, measure, record, table
from worker.detectors.card import MODEL_STORE, PrecisionCheck
from worker.detectors.running.runtime import Runtime
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.store import open_card, open_detector, write_card

MODEL = "spicd-net/1"


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with SPICD-Net, of which nothing is recorded."""
    shutil.copytree(MODEL_STORE / MODEL, tmp_path / MODEL)
    write_card(tmp_path / MODEL, open_card(tmp_path, MODEL).model_copy(update={"precision": {}}))
    return tmp_path


@pytest.fixture(autouse=True)
def _has_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any processor can compute so, if slowly."""
    monkeypatch.setattr("worker.detectors.precision.has_bfloat16", lambda device: True)


def check_of(**values: object) -> PrecisionCheck:
    sha256 = open_card(MODEL_STORE, MODEL).sha256
    known: dict[str, object] = {
        "largest_score_difference": 0.001,
        "decided_otherwise": 0,
        "tiles": 100,
        "sha256": sha256,
        "device": "a processor",
        "data": "some rooms",
        "command": "spicd-worker evaluate precision",
    }
    return PrecisionCheck.model_validate({**known, **values})


def test_scores_in_bfloat16_are_measured_and_recorded(store: Path) -> None:
    settings = PrecisionSettings(
        model=MODEL, model_store=store, device="cpu", way="cuda", offices=1, scans=2, edits=2
    )
    check = measure(settings)
    assert 0 < check.largest_score_difference < 0.02  # another precision, and the same network
    assert check.tiles > 10
    assert "as a GPU computes" in check.device
    assert "--way cuda" in check.command
    assert table(check, MODEL).row_count == 3
    before = open_card(store, MODEL)
    record(settings, check)
    card = open_card(store, MODEL)
    assert card.precision == {"cuda": check}
    assert card.evaluation == before.evaluation


@pytest.mark.parametrize(
    ("check", "holds"),
    [
        (check_of(), True),
        (check_of(largest_score_difference=0.02), False),
        (check_of(decided_otherwise=1), False),
        (check_of(sha256="0" * 64), False),
    ],
)
def test_a_model_computes_so_where_its_own_scores_hold(
    store: Path, check: PrecisionCheck, holds: bool
) -> None:
    record(PrecisionSettings(model=MODEL, model_store=store, way="cuda"), check)
    card = open_card(store, MODEL)
    assert card.holds_in_bfloat16("cuda") is holds
    assert not card.model_copy(update={"precision": {}}).holds_in_bfloat16("cuda")


def test_a_detector_is_told_by_its_card(store: Path) -> None:
    record(PrecisionSettings(model=MODEL, model_store=store, way="cuda"), check_of())
    for at_once, precision in ((True, "bfloat16"), (False, "float32")):
        detector = open_detector(store, MODEL, "cpu", Runtime(precision="auto", at_once=at_once))
        assert isinstance(detector, SpicdNet)
        assert detector._precision == precision


def test_a_model_without_a_network_has_no_precision(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="voxel-rule/1 has no network"):
        measure(PrecisionSettings(model="voxel-rule/1", device="cpu", offices=1, scans=2, edits=1))


@pytest.mark.parametrize(
    ("device", "way", "used"), [("cuda", "cpu", "cpu"), ("cuda", "cuda", "cuda"), ("auto", None, "auto")]
)
def test_the_processors_way_is_measured_on_a_processor(device: str, way: str | None, used: str) -> None:
    """A GPU that is told to compute so does not search in 8 bits: it would be compared with itself."""
    assert PrecisionSettings(model=MODEL, device=device, way=way).computes_on == used  # type: ignore[arg-type]
