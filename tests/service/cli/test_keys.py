"""`spicd keys` on a catalog in a folder, and SPICD_KEY on its way to the service."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.catalog.keys import open_keys
from service.cli import main
from service.client import Client, ClientError
from service.settings import Settings


def spicd(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    return int(ended.value.code or 0)


@pytest.fixture
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("SPICD_DATABASE_URL", raising=False)
    monkeypatch.setenv("SPICD_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path / "data"


def added(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert spicd("keys", "add", *words, "--json") == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


def test_a_key_is_made_before_the_service_ever_ran_and_shown_once(
    data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scopes = ["--scope", "scans:write", "--scope", "surveys:write"]
    key = added(capsys, "robot 7", *scopes, "--map", "lobby", "--days", "30")
    with open_keys(Settings(data_dir=data_dir)) as keys:
        found = keys.find(key["secret"])
    assert found is not None
    assert (found.name, found.maps, found.scopes) == ("robot 7", ("lobby",), ("scans:write", "surveys:write"))
    assert found.expires is not None
    assert (found.expires - found.created).days in (29, 30)
    assert spicd("keys", "list") == 0
    shown = capsys.readouterr().out
    assert key["key_id"] in shown
    assert "robot 7" in shown
    assert key["secret"] not in shown


def test_a_key_is_revoked_by_its_id(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = added(capsys, "guest", "--scope", "changes:read")
    assert spicd("keys", "revoke", key["key_id"]) == 0
    with open_keys(Settings(data_dir=data_dir)) as keys:
        assert keys.find(key["secret"]) is None
    capsys.readouterr()
    assert spicd("keys", "list") == 0
    assert "revoked" in capsys.readouterr().out
    assert spicd("keys", "revoke", "key-none") == 1
    assert "spicd keys list" in capsys.readouterr().err


def test_a_secret_that_is_mounted_gives_one_key_however_often_the_container_starts(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = "spicd_" + "0123456789abcdef" * 4
    (tmp_path / "secret").write_text(secret + "\n")
    words = ("first", "--scope", "admin", "--secret-file", str(tmp_path / "secret"))
    first, again = added(capsys, *words), added(capsys, *words)
    assert first == again
    assert secret not in json.dumps(first)
    with open_keys(Settings(data_dir=data_dir)) as keys:
        assert keys.find(secret) is not None


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("x", "--scope", "everything"), "no scope 'everything'"),
        (("x", "--scope", "admin", "--map", "lobby"), "cannot be bound"),
        (("x", "--scope", "admin", "--secret-file", "/nonexistent"), "cannot be read"),
        (("x", "--scope", "admin", "--secret-file", "/dev/null"), "256 random bits"),
    ],
)
def test_what_makes_no_key_is_told_in_a_sentence(
    data_dir: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], sentence: str
) -> None:
    assert spicd("keys", "add", *words) == 1
    assert sentence in capsys.readouterr().err


def test_a_database_that_cannot_be_opened_is_told_without_its_password(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SPICD_DATABASE_URL", "postgresql://spicd:hunter2@127.0.0.1:1/spicd")
    assert spicd("keys", "list") == 1
    said = capsys.readouterr().err
    assert "database" in said
    assert "hunter2" not in said


@pytest.mark.parametrize(
    ("environment", "given", "sent"),
    [
        (None, None, None),
        ("spicd_e\n", None, "Bearer spicd_e"),
        ("spicd_e", "spicd_g", "Bearer spicd_g"),
        ("spicd_e", "", None),
    ],
)
def test_the_client_sends_the_key_of_the_environment_or_the_one_given(
    monkeypatch: pytest.MonkeyPatch, environment: str | None, given: str | None, sent: str | None
) -> None:
    monkeypatch.delenv("SPICD_KEY", raising=False)
    if environment is not None:
        monkeypatch.setenv("SPICD_KEY", environment)
    seen: list[str | None] = []

    def answer(request: httpx.Request) -> httpx.Response:
        seen.append(request.headers.get("Authorization"))
        return httpx.Response(200, json={})

    with Client("http://there", key=given, transport=httpx.MockTransport(answer)) as client:
        client.job("job-1")
    assert seen == [sent]


def test_a_key_that_no_header_takes_is_told_without_its_text() -> None:
    with pytest.raises(ClientError, match="SPICD_KEY") as caught:
        Client("http://there", key="spicd_\nhunter2")
    assert "hunter2" not in str(caught.value)
