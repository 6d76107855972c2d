"""Settings: what is left out is found where it is expected, whatever the folders are called."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from service import settings as settings_module
from service.catalog.catalog import open_catalog
from service.settings import Settings

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in Settings.model_fields:
        monkeypatch.delenv(f"SPICD_{name.upper()}", raising=False)


def test_an_empty_variable_counts_as_unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPICD_REDIS_URL", "")
    monkeypatch.setenv("SPICD_PORT", "")
    assert Settings().redis_url is None
    assert Settings().port == 8000


@pytest.mark.parametrize("name", ["a?b", "50%41", "a b#c", "räume", "%3F"])
def test_the_embedded_parts_lie_in_the_data_folder_whatever_it_is_called(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    catalog = open_catalog(Settings(data_dir=folder))
    catalog.blobs.put_bytes("a/b", b"x")
    catalog.close()
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (folder / "spicd.sqlite").is_file()
    assert (folder / "blobs" / "a" / "b").read_bytes() == b"x"


def test_a_database_that_is_named_is_taken_as_it_is(tmp_path: Path) -> None:
    given = "postgresql://spicd:a%40b@db/spicd?sslmode=require"
    assert Settings(data_dir=tmp_path, database_url=given).resolved_database_url() == given


def test_the_models_are_those_of_the_checkout_wherever_the_process_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "checkout" / "model_store").mkdir(parents=True)
    monkeypatch.setattr(settings_module, "__file__", str(tmp_path / "checkout" / "service" / "settings.py"))
    monkeypatch.chdir(tmp_path)
    assert Settings().model_store == tmp_path / "checkout" / "model_store"


def test_without_a_checkout_the_models_are_looked_for_where_the_process_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(settings_module, "__file__", str(tmp_path / "service" / "settings.py"))
    assert Settings().model_store == Path("model_store")


def test_scratch_is_in_the_data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Settings(data_dir=Path("data")).scratch_dir() == tmp_path / "data" / "scratch"


@pytest.mark.parametrize(
    ("given", "path"), [("/spicd", "/spicd"), ("/a/b-1/", "/a/b-1"), ("/", None), ("", None)]
)
def test_a_prefix_is_a_path_without_its_last_slash(given: str, path: str | None) -> None:
    assert Settings(root_path=given).root_path == path


@pytest.mark.parametrize("given", ["spicd", "//evil.example", "/a//b", "/a b", "/a?b", "https://host/spicd"])
def test_what_is_no_path_is_not_taken_for_a_prefix(given: str) -> None:
    with pytest.raises(ValidationError, match="no path to be under"):
        Settings(root_path=given)
