"""A training becomes a model of a store, and never takes the place of one that is there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.support.models import make_untrained
from worker.cli import main
from worker.cli.publish import new_model, next_version


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
    """What was to be published, instead of publishing."""
    calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def remember(*places: Any, **options: Any) -> Path:
        calls.append((places, options))
        return Path("written")

    monkeypatch.setattr("worker.training.publish.publish", remember)
    return calls


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["publish", *words])
    return int(end.value.code or 0)


def test_the_best_checkpoint_of_a_folder_becomes_the_model_that_was_named(
    tmp_path: Path, asked: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    store = tmp_path / "store"
    assert run(str(tmp_path), "--model", "kpconv/2", "--model-store", str(store), "--summary", "ours") == 0
    ((places, options),) = asked
    assert places == (tmp_path / "best.pt", tmp_path / "tiles.npz", store)
    assert (options["name"], options["version"], options["summary"]) == ("kpconv", "2", "ours")
    assert "--model kpconv/2" in capsys.readouterr().out


def test_a_model_that_is_there_is_refused_with_the_next_version(
    tmp_path: Path, asked: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    make_untrained(tmp_path / "spicd-net" / "1")
    assert run(str(tmp_path), "--model", "spicd-net/1", "--model-store", str(tmp_path)) == 1
    assert "give another version, as spicd-net/2" in " ".join(capsys.readouterr().err.split())
    assert asked == []


@pytest.mark.parametrize("name", ["kpconv", "kpconv/", "/1", "a/b/c", "../1", "a/.."])
def test_what_is_no_name_and_version_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="name and version are wanted"):
        new_model(tmp_path, name)


def test_the_next_version_is_after_the_largest_number(tmp_path: Path) -> None:
    assert next_version(tmp_path, "voxel-net") == "1"
    for version in ("2", "10", "try"):
        (tmp_path / "voxel-net" / version).mkdir(parents=True)
    assert next_version(tmp_path, "voxel-net") == "11"


def test_voxels_are_not_trained_for_a_version_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "voxel-net" / "1").mkdir(parents=True)
    with pytest.raises(SystemExit, match="1"):
        main(["train-voxels", str(tmp_path / "run"), "--store", str(tmp_path), "--version", "1"])
    assert "voxel-net/1 is in" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()
